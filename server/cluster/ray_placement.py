"""Placement of scene processes as actors on a Ray cluster.

Ray chooses the node of each process and reports lost nodes.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import secrets
from collections.abc import Callable, Coroutine, Mapping, Sequence
from functools import partial
from typing import Any, TypeVar
from weakref import WeakSet

import ray
from ray.exceptions import RayActorError, RayError

from client.wire import Cluster
from server.cluster.folder_marker import write_marker
from server.cluster.membership import Membership
from server.cluster.node_watch import NodeWatch
from server.cluster.nodes import PlacedProcess, all_nodes, describe_cluster, is_lost
from server.cluster.process_host import ProcessHost, ProcessScheduling, StartResult, UnexpectedExit
from server.cluster.ray_calls import RayCalls
from server.cluster.resource_needs import ResourceNeeds, resource_needs
from server.cluster.service_registry import peer_addresses, register_service
from server.cluster.shared_folder import check_folder
from server.messages import WaitsForNode
from server.processes import worker
from server.processes.placement import STOP_SECONDS, Entry, Placement, ProcessExit, ProcessHandle
from server.settings import ServerSettings

WAIT_S = 3.0
"""Time in seconds after which a worker without a node reports the resources that it needs."""
LOST_S = 10.0
"""Maximum time in seconds to wait for the head node to report whether a node is lost."""
LOSE_S, CLOSE_S = 20.0, 3.0
"""Maximum time in seconds to wait for pending Ray calls before leaving: after losing the cluster, and at shutdown."""
STOPPED_S = 5.0
"""Time in seconds for an actor to report the exit of its process, in addition to the time for the exit itself."""

T = TypeVar("T")

log = logging.getLogger("scas4d.server")


class RayPlacement(Placement):
    """Placement that runs scene processes on a Ray cluster and the service's own processes on its machine.

    Args:
        prepare: function that is called first in every process; see `Placement`.
        address: address of the head node; None selects the cluster on this machine or the one in RAY_ADDRESS.
        server: service settings; the data folder must be visible on every node at the same path.

    Attributes:
        placed: processes that were requested and have not exited, keyed by the names of their actors.
    """

    fenced = True
    has_peers = True
    has_labels = True

    def __init__(self, prepare: Callable[[], None] | None, address: str | None, server: ServerSettings) -> None:
        super().__init__(prepare)
        self.placed: dict[str, PlacedProcess] = {}
        self._calls = RayCalls()
        self._watch = NodeWatch(partial(self.call_ray, all_nodes))
        self._server = server
        self._membership = Membership(address)
        self._processes: WeakSet[RayProcess] = WeakSet()
        self._token = secrets.token_hex(3)
        self._started = 0
        self._listens: tuple[str, int] | None = None
        self._announced: Any = None
        self._kept: list[Any] = []
        """Objects with references to Ray handles or results, kept alive while the service leaves the cluster.

        If one were released in the meantime, Ray would hang or end this process.
        """
        self._keeping: asyncio.Task[None] | None = None
        self._peers: Mapping[str, str] | None = None

    async def open(self) -> None:
        """Joins the cluster and checks that all nodes see the data folder.

        Raises:
            RuntimeError: there is no cluster, or a node does not see the folder.
        """
        data = self._server.data.resolve()
        before = ray.is_initialized()  # `serve` first opens the placement in another event loop to report errors
        await asyncio.to_thread(self._membership.join)
        if not before:
            await asyncio.to_thread(check_folder, data)
            await asyncio.to_thread(write_marker, data, self._token)
            self._watch.record(await asyncio.to_thread(all_nodes))  # `poll` would bind the answer to this event loop
            log.info("running scenes on a Ray cluster with %d nodes", sum(node["Alive"] for node in self._watch.nodes))
        self._keeping = asyncio.get_running_loop().create_task(
            self._membership.watch(on_loss=self._lose_all, on_return=self._on_return)
        )

    async def _lose_all(self) -> None:
        processes = tuple(self._processes)
        for process in processes:
            try:
                process.mark_lost()
            except Exception:  # an error in one scene must not stop the other scenes or the service
                log.exception("error while handling a process that was lost with the cluster")
        await self._detach(processes, LOSE_S)

    async def _detach(self, processes: Sequence[RayProcess], seconds: float) -> None:
        """Stops all calls to Ray, and keeps all Ray handles and results alive."""
        self._calls.suspend()
        self._kept += [self._announced, *processes, *self._calls.running]
        for process in processes:
            await process.detach()
        if not await self._calls.wait(seconds):
            log.warning("Ray did not respond within %g s; leaving the cluster anyway", seconds)
        gc.collect()  # a later collection could release Ray objects while the service leaves

    async def _on_return(self) -> None:
        self._kept.clear()
        self._calls.resume()
        await self._announce()

    async def cluster(self) -> Cluster:
        """See `Placement`."""
        watch = self._watch
        await watch.poll()
        return describe_cluster(watch.nodes, self.placed.values(), lost=watch.lost, head_responds=watch.head_responds)

    async def announce(self, host: str, port: int) -> None:
        """Announces the address of this service through an actor; see `Placement`.

        The actor ends when the service exits.
        """
        self._listens = host, port
        await self._announce()

    async def _announce(self) -> None:
        if self._listens is not None:
            self._announced = await self.call_ray(register_service, self._token, *self._listens)

    async def peers(self) -> Sequence[str]:
        """Returns the addresses of the other services, or the last known addresses if the head node does not respond.

        See `Placement`.
        """
        self._peers = await self.call_ray(peer_addresses, self._token, self._peers)
        return list(self._peers.values())

    def call_ray(self, function: Callable[..., T], *arguments: Any) -> asyncio.Future[T]:
        """Calls a function that uses Ray, in a thread.

        The call waits until the service is a member of the cluster.
        """
        return self._calls.call(function, *arguments)

    async def close(self) -> None:
        """Leaves the cluster, which ends the remaining actors."""
        if self._keeping is not None:
            self._keeping.cancel()
        await self._detach(tuple(self._processes), CLOSE_S)
        self._calls.close()
        await asyncio.to_thread(self._membership.leave)

    def start(
        self, entry: Entry, spec: Any, on_message: Callable[[Any], None], on_end: Callable[[ProcessExit], None]
    ) -> ProcessHandle:
        """Starts a process on a node with sufficient resources; see `Placement`."""
        needs = resource_needs(entry, spec, self._server)
        if needs is None:
            return super().start(entry, spec, on_message, on_end)
        self._started += 1
        epoch = spec.folder.epoch if entry is worker.main else self._started
        name = f"{needs.scene}.{needs.role}.{epoch}.{self._token}"
        self.placed[name] = PlacedProcess(needs)
        process = RayProcess(self, name, needs, (entry, spec), on_message, on_end)
        self._processes.add(process)
        return process

    def create_actor(self, name: str, needs: ResourceNeeds) -> Any:
        """Creates the actor of a process. Blocks until the head node has registered the name."""
        made: Any = ray.remote(ProcessHost)
        return made.options(name=name, **needs.actor_options()).remote(
            self.prepare, self._server.data.resolve(), self._token, ProcessScheduling.current()
        )


class RayProcess:
    """Scene process on a cluster node; messages are exchanged through its actor.

    All methods run on the event loop, which never waits for Ray.
    """

    def __init__(
        self,
        placement: RayPlacement,
        name: str,
        needs: ResourceNeeds,
        runs: tuple[Entry, Any],
        on_message: Callable[[Any], None],
        on_end: Callable[[ProcessExit], None],
    ) -> None:
        self._placement = placement
        self._name = name
        self._needs = needs
        self._on_message = on_message
        self._on_end = on_end
        self._node: str | None = None
        self._pid: int | None = None
        self._early: list[Any] | None = []
        """Messages sent before the actor exists; None afterwards."""
        self._sent = 0
        self._over = False
        self._lost = False
        self._actor: Any = None
        self._making: asyncio.Future[Any] = placement.call_ray(placement.create_actor, name, needs)
        self._answers: set[Any] = set()
        """Results that are being awaited, or were being awaited when the cluster was lost."""
        self._tasks: set[asyncio.Task[Any]] = set()
        self._task = self._start_task(self._run(*runs))

    @property
    def pid(self) -> int | None:
        """See `ProcessHandle`."""
        return self._pid

    def send(self, message: Any) -> None:
        """See `ProcessHandle`."""
        if self._over:
            return
        if self._early is not None:
            self._early.append(message)
            return
        self._start_task(self._post(self._actor.post.remote(self._sent, message)))
        self._sent += 1

    async def stop(self, seconds: float = STOP_SECONDS) -> None:
        """See `ProcessHandle`."""
        started, over, self._over = self._pid is not None, self._over, True
        self._task.cancel()
        self._placement.placed.pop(self._name, None)
        if started and not over:
            await asyncio.wait({self._start_task(self._ask_to_stop(seconds))})
        await asyncio.wait({self._start_task(self._kill())}, timeout=STOPPED_S)  # continues after a timeout

    def mark_lost(self) -> None:
        """Gives up the process because its cluster is lost."""
        self._lost = True
        self._give_up("the service lost its Ray node", lost=True)

    async def detach(self) -> None:
        """Stops all calls to the actor, including its creation, and keeps its results alive."""
        self._lost = self._over = True
        asked = {self._making, *self._tasks}
        for each in asked:
            each.cancel()
        await asyncio.wait(asked)

    async def _run(self, entry: Entry, spec: Any) -> None:
        role = self._needs.role
        try:
            await self._begin(entry, spec)
            while not self._over:
                for message in await self._result(self._actor.receive.remote()):
                    if isinstance(message, UnexpectedExit):
                        self._end(ProcessExit(message.exit_code, out_of_memory=message.out_of_memory))
                    elif not self._over:
                        self._notify(message)
        except RayActorError as error:
            log.warning("lost actor %s: %s", self._name, error)
            if self._node is not None and await self._is_lost(self._node):
                self._give_up(f"the node of the {role} process was lost", lost=True)
            else:
                self._give_up(f"the actor of the {role} process exited: {_first_line(error)}")
        except (RayError, _StartFailedError) as error:
            log.warning("actor %s failed to start: %s", self._name, error)
            self._give_up(f"the {role} process could not be started: {_first_line(error)}")
        except Exception as error:  # any error must be handled, or the scene would hang
            log.exception("error in actor %s", self._name)
            self._give_up(f"the {role} process was abandoned: {type(error).__name__}: {error}")

    async def _begin(self, entry: Entry, spec: Any) -> None:
        """Starts the process; if a worker has no node after `WAIT_S`, reports the resources that the worker needs."""
        self._actor = await asyncio.shield(self._making)
        starting = self._start_task(self._result(self._actor.start.remote(entry, spec)))
        starting.add_done_callback(lambda done: done.cancelled() or done.exception())  # avoids a warning after `stop`
        early, self._early = self._early or [], None
        for message in early:
            self.send(message)
        said = False
        while not (await asyncio.wait([starting], timeout=WAIT_S))[0]:
            if self._needs.role == "worker" and not said:
                said = True
                self._notify(WaitsForNode(f"the worker is waiting for a node with {self._needs.describe()}"))
        started: StartResult = starting.result()
        if started.fault is not None:
            raise _StartFailedError(started.fault)
        self._pid, self._node = started.pid, started.node
        if self._over:  # the process was given up in the meantime
            return
        self._placement.placed[self._name] = PlacedProcess(self._needs, started.node)

    async def _is_lost(self, node: str) -> bool:
        try:
            return await asyncio.wait_for(self._placement.call_ray(is_lost, node), LOST_S)
        except TimeoutError:  # the head node does not respond
            return True

    def _notify(self, message: Any) -> None:
        try:
            self._on_message(message)
        except Exception:  # an error in the service must not affect the next message
            log.exception("error while handling a message of actor %s", self._name)

    async def _ask_to_stop(self, seconds: float) -> None:
        with contextlib.suppress(RayError, TimeoutError):
            await asyncio.wait_for(self._result(self._actor.stop.remote(seconds)), seconds + STOPPED_S)

    async def _result(self, asked: Any) -> Any:
        self._answers.add(asked)
        try:
            return await asked
        finally:
            if not self._lost:
                self._answers.discard(asked)

    async def _post(self, sending: Any) -> None:
        try:
            await self._result(sending)
        except RayActorError:
            pass  # `_run` receives the same error and handles it
        except RayError as error:  # the process has missed a message, so it must not continue
            self._give_up(f"could not send a message to the {self._needs.role} process: {_first_line(error)}")

    def _give_up(self, why: str, *, lost: bool = False) -> None:
        self._end(ProcessExit(None, why, lost=lost, out_of_memory=False))

    def _end(self, why: ProcessExit) -> None:
        if not self._over:
            self._over = True
            self._placement.placed.pop(self._name, None)
            self._start_task(self._kill())
            self._on_end(why)

    async def _kill(self) -> None:
        if self._lost:
            return
        with contextlib.suppress(RayError, ValueError, OSError, RuntimeError):
            await self._placement.call_ray(ray.kill, await asyncio.shield(self._making))

    def _start_task(self, coroutine: Coroutine[Any, Any, Any]) -> asyncio.Task[Any]:
        task = asyncio.get_running_loop().create_task(coroutine)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task


def _first_line(error: BaseException) -> str:
    """Returns the first line of an error message; Ray's full message, meant for cluster operators, is in the log."""
    return str(error).strip().partition("\n")[0]


class _StartFailedError(RuntimeError):
    """Error for a process that its node could not start."""
