"""Runs the processes of scenes as actors on a Ray cluster. Ray chooses the node, and reports when one is lost."""

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
from server.cluster.calls import Calls
from server.cluster.folder import check_folder
from server.cluster.host import Host, NodeGone, ProcessPriority, Started
from server.cluster.marks import mark
from server.cluster.membership import Membership
from server.cluster.needs import Needs, needs_of
from server.cluster.nodes import Place, all_nodes, cluster_of, is_lost
from server.cluster.services import announced, others
from server.cluster.watch import NodeWatch
from server.messages import WaitsForNode
from server.processes import worker
from server.processes.placement import STOP_SECONDS, AnyProcess, Entry, Placement, ProcessExit
from server.settings import ServerSettings

WAIT_S = 3.0
"""A worker that is not placed after so long says what it waits for."""
LOST_S = 10.0
"""The head says within so long whether a node is lost."""
LOSE_S, CLOSE_S = 20.0, 3.0
"""The service waits so long for what it has asked of Ray before it leaves: a lost cluster, and when it ends."""
STOPPED_S = 5.0
"""An actor has so much longer than its process to say that this has ended."""

T = TypeVar("T")

log = logging.getLogger("scas4d.server")


class RayPlacement(Placement):
    """Starts processes of scenes on a cluster, and those of the service on its own machine.

    Args:
        prepare: see `Placement`. address: of the cluster's head, or None: that which runs on this machine, or that of
            RAY_ADDRESS. server: settings of the service; every node has to see its data folder at the same path.

    Attributes:
        places: of processes that were started and have not ended, by name of their actor.
    """

    fenced = True
    has_siblings = True
    has_labels = True

    def __init__(self, prepare: Callable[[], None] | None, address: str | None, server: ServerSettings) -> None:
        super().__init__(prepare)
        self.places: dict[str, Place] = {}
        self._calls = Calls()
        self._watch = NodeWatch(partial(self.asked, all_nodes))
        self._server = server
        self._membership = Membership(address)
        self._processes: WeakSet[RayProcess] = WeakSet()
        self._token = secrets.token_hex(3)
        self._started = 0
        self._listens: tuple[str, int] | None = None
        self._announced: Any = None
        self._kept: list[Any] = []
        """What has handles and answers of Ray's. Ray ends this process, or stands still, where one is dropped while the
        service leaves."""
        self._keeping: asyncio.Task[None] | None = None
        self._siblings: Mapping[str, str] | None = None

    async def open(self) -> None:
        """Joins the cluster, and checks that all nodes see the data folder.

        Raises:
            RuntimeError: there is no cluster, or a node does not see the folder.
        """
        data = self._server.data.resolve()
        before = ray.is_initialized()  # `serve` opens it in a loop of its own, to say what is wrong
        await asyncio.to_thread(self._membership.join)
        if not before:
            await asyncio.to_thread(check_folder, data)
            await asyncio.to_thread(mark, data, self._token)
            self._watch.saw(await asyncio.to_thread(all_nodes))  # not `look`: the answer would be lost with the loop
            log.info("scenes run on a Ray cluster of %d nodes", sum(node["Alive"] for node in self._watch.nodes))
        self._keeping = asyncio.get_running_loop().create_task(
            self._membership.keep(on_loss=self._lose_all, on_return=self._return)
        )

    async def _lose_all(self) -> None:
        processes = tuple(self._processes)
        for process in processes:
            try:
                process.lose()
            except Exception:  # a fault of one scene's keeps none of the others, nor the service, from going on
                log.exception("a process that is lost with its cluster")
        await self._let_go(processes, LOSE_S)

    async def _let_go(self, processes: Sequence[RayProcess], seconds: float) -> None:
        """Asks Ray nothing more, and keeps all handles and answers of Ray's."""
        self._calls.hold()
        self._kept += [self._announced, *processes, *self._calls.begun]
        for process in processes:
            await process.let_go()
        if not await self._calls.over(seconds):
            log.warning("Ray has not answered within %g s; the service leaves the cluster nevertheless", seconds)
        gc.collect()  # by itself it may come while the service leaves, and drop what only cycles hold

    async def _return(self) -> None:
        self._kept.clear()
        self._calls.go_on()
        await self._announce()

    async def cluster(self) -> Cluster:
        """See `Placement`."""
        watch = self._watch
        await watch.look()
        return cluster_of(watch.nodes, self.places.values(), lost=watch.lost, answers=watch.answers)

    async def announce(self, host: str, port: int) -> None:
        """See `Placement`: an actor has the address, and goes with this service."""
        self._listens = host, port
        await self._announce()

    async def _announce(self) -> None:
        if self._listens is not None:
            self._announced = await self.asked(announced, self._token, *self._listens)

    async def peers(self) -> Sequence[str]:
        """See `Placement`; what was known before where the head does not answer."""
        self._siblings = await self.asked(others, self._token, self._siblings)
        return list(self._siblings.values())

    def asked(self, function: Callable[..., T], *arguments: Any) -> asyncio.Future[T]:
        """Calls what asks Ray, in a thread, while the service is a member of the cluster."""
        return self._calls.asked(function, *arguments)

    async def close(self) -> None:
        """Leaves the cluster; actors that are left end."""
        if self._keeping is not None:
            self._keeping.cancel()
        await self._let_go(tuple(self._processes), CLOSE_S)
        self._calls.close()
        await asyncio.to_thread(self._membership.leave)

    def start(
        self, entry: Entry, spec: Any, on_message: Callable[[Any], None], on_end: Callable[[ProcessExit], None]
    ) -> AnyProcess:
        """Starts a process on the node that has room; see `Placement`."""
        needs = needs_of(entry, spec, self._server)
        if needs is None:
            return super().start(entry, spec, on_message, on_end)
        self._started += 1
        epoch = spec.folder.epoch if entry is worker.main else self._started
        name = f"{needs.scene}.{needs.role}.{epoch}.{self._token}"
        self.places[name] = Place(needs)
        process = RayProcess(self, name, needs, (entry, spec), on_message, on_end)
        self._processes.add(process)
        return process

    def host(self, name: str, needs: Needs) -> Any:
        """An actor for a process. Blocking: the head registers its name."""
        made: Any = ray.remote(Host)
        return made.options(name=name, **needs.options()).remote(
            self.prepare, self._server.data.resolve(), self._token, ProcessPriority.here()
        )


class RayProcess:
    """A process of a scene on some node; its messages go by its actor. On the event loop, which never waits for Ray."""

    def __init__(
        self,
        placement: RayPlacement,
        name: str,
        needs: Needs,
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
        """Messages before there is an actor."""
        self._sent = 0
        self._over = False
        self._lost = False
        self._actor: Any = None
        self._making: asyncio.Future[Any] = placement.asked(placement.host, name, needs)
        self._answers: set[Any] = set()
        """Answers that are waited for, or were when the cluster was lost."""
        self._tasks: set[asyncio.Task[Any]] = set()
        self._task = self._beside(self._run(*runs))

    @property
    def pid(self) -> int | None:
        """See `AnyProcess`."""
        return self._pid

    def send(self, message: Any) -> None:
        """See `AnyProcess`."""
        if self._over:
            return
        if self._early is not None:
            self._early.append(message)
            return
        self._beside(self._post(self._actor.post.remote(self._sent, message)))
        self._sent += 1

    async def stop(self, seconds: float = STOP_SECONDS) -> None:
        """See `AnyProcess`."""
        started, over, self._over = self._pid is not None, self._over, True
        self._task.cancel()
        self._placement.places.pop(self._name, None)
        if started and not over:
            await asyncio.wait({self._beside(self._ask_to_stop(seconds))})
        await asyncio.wait({self._beside(self._kill())}, timeout=STOPPED_S)  # it goes on where the head is silent

    def lose(self) -> None:
        """Gives it up with the cluster on which it ran."""
        self._lost = True
        self._give_up("the Ray node of the service's machine is lost", lost=True)

    async def let_go(self) -> None:
        """Asks the actor nothing more, and makes none; its answers are kept."""
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
                for message in await self._answer(self._actor.take.remote()):
                    if isinstance(message, NodeGone):
                        self._end(ProcessExit(message.exit_code, starved=message.starved))
                    elif not self._over:
                        self._tell(message)
        except RayActorError as error:
            log.warning("actor %s is lost: %s", self._name, error)
            if self._node is not None and await self._is_lost(self._node):
                self._give_up(f"the node of its {role} is lost", lost=True)
            else:
                self._give_up(f"the actor of its {role} ended: {_first_line(error)}")
        except (RayError, _NotStarted) as error:
            log.warning("actor %s did not start: %s", self._name, error)
            self._give_up(f"its {role} could not be started: {_first_line(error)}")
        except Exception as error:  # whatever it is, the scene must not stand still
            log.exception("actor %s", self._name)
            self._give_up(f"its {role} was given up: {type(error).__name__}: {error}")

    async def _begin(self, entry: Entry, spec: Any) -> None:
        """Starts the process, and says what it waits for as long as no node has room."""
        self._actor = await asyncio.shield(self._making)
        starting = self._beside(self._answer(self._actor.start.remote(entry, spec)))
        starting.add_done_callback(lambda done: done.cancelled() or done.exception())  # who stops it does not ask
        early, self._early = self._early or [], None
        for message in early:
            self.send(message)
        said = False
        while not (await asyncio.wait([starting], timeout=WAIT_S))[0]:
            if self._needs.role == "worker" and not said:
                said = True
                self._tell(WaitsForNode(f"its worker is not placed on a node yet; it needs {self._needs.words()}"))
        started: Started = starting.result()
        if started.fault is not None:
            raise _NotStarted(started.fault)
        self._pid, self._node = started.pid, started.node
        if self._over:  # it was given up meanwhile
            return
        self._placement.places[self._name] = Place(self._needs, started.node)

    async def _is_lost(self, node: str) -> bool:
        try:
            return await asyncio.wait_for(self._placement.asked(is_lost, node), LOST_S)
        except TimeoutError:  # the head does not say
            return True

    def _tell(self, message: Any) -> None:
        try:
            self._on_message(message)
        except Exception:  # a fault of the service's own: the next message is none of it
            log.exception("a message of actor %s", self._name)

    async def _ask_to_stop(self, seconds: float) -> None:
        with contextlib.suppress(RayError, TimeoutError):
            await asyncio.wait_for(self._answer(self._actor.stop.remote(seconds)), seconds + STOPPED_S)

    async def _answer(self, asked: Any) -> Any:
        self._answers.add(asked)
        try:
            return await asked
        finally:
            if not self._lost:
                self._answers.discard(asked)

    async def _post(self, sending: Any) -> None:
        try:
            await self._answer(sending)
        except RayActorError:
            pass  # `_run` learns of it, too, and says what became of it
        except RayError as error:  # it did not get the message, so it must not go on
            self._give_up(f"a message did not reach its {self._needs.role}: {_first_line(error)}")

    def _give_up(self, why: str, *, lost: bool = False) -> None:
        self._end(ProcessExit(None, why, lost=lost, starved=False))

    def _end(self, why: ProcessExit) -> None:
        if not self._over:
            self._over = True
            self._placement.places.pop(self._name, None)
            self._beside(self._kill())
            self._on_end(why)

    async def _kill(self) -> None:
        if self._lost:
            return
        with contextlib.suppress(RayError, ValueError, OSError, RuntimeError):
            await self._placement.asked(ray.kill, await asyncio.shield(self._making))

    def _beside(self, coroutine: Coroutine[Any, Any, Any]) -> asyncio.Task[Any]:
        task = asyncio.get_running_loop().create_task(coroutine)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task


def _first_line(error: BaseException) -> str:
    """Ray's messages go on with what people need who look after the cluster; the log has all of it."""
    return str(error).strip().partition("\n")[0]


class _NotStarted(RuntimeError):
    """The node could not start the process."""
