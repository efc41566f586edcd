"""Placement of the simulation: its processes wait in a queue, run on a node, and send messages with a delay."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable, Coroutine
from dataclasses import replace
from typing import Any

from server.cluster.resource_needs import ResourceNeeds
from server.messages import SceneSpec, WaitsForNode
from server.processes.placement import STOP_SECONDS, Entry, Placement, ProcessExit, ProcessHandle
from studies.simulation.cluster import SimulatedCluster
from studies.simulation.delays import LATE_S, LONGEST_SHARE, MESSAGE_S, STOPPING_S, TOLD_S, WAIT_S
from studies.simulation.nodes import Node, NodeState
from studies.simulation.record import FrameRecord, TimeRecord
from studies.simulation.work import Work


class SimulatedProcess:
    """A simulated worker process that behaves like `RayProcess`.

    Once its end has been reported, the service receives no more messages from it.

    Attributes:
        over: whether the service has given up this process, or the service itself has ended.
        work: work of the process; None before it has a place and after it has ended.
    """

    def __init__(
        self,
        placement: SimulatedPlacement,
        needs: ResourceNeeds,
        spec: SceneSpec,
        on_message: Callable[[Any], None],
        on_end: Callable[[ProcessExit], None],
    ) -> None:
        self.needs = needs
        self.over = False
        self.work: Work | None = None
        self.node: Node | None = None
        self._placement = placement
        self._cluster, self._times = placement.simulated, placement.times
        self._kind = self._cluster.capacity.kind(needs)
        self._spec = spec
        self._on_message, self._on_end = on_message, on_end
        beside = any(not other.over for other in placement.processes.get(needs.scene, ()))
        self._number = placement.frames.start(needs.scene, beside)
        self._last_message = self._last_order = 0.0
        self._times.ask(needs.scene)
        self._cluster.queue(self)
        self._cluster.later(WAIT_S, self._explain)

    @property
    def pid(self) -> int | None:
        """Number of the worker, or None before it has a place and after it has ended."""
        return None if self.work is None else self._number

    @property
    def queued(self) -> bool:
        """Whether the process waits for a place."""
        return self.node is None and not self.over

    # Called by the service.

    def send(self, message: Any) -> None:
        """Sends a message to the worker; see `ProcessHandle`. Without a running worker, the message is dropped."""
        if not self.over and self.work is not None:
            work = self.work
            self._last_order = self._pass(lambda: work.order(message), self._last_order)

    async def stop(self, seconds: float = STOP_SECONDS) -> None:
        """Gives up the process and stops its worker, within ``seconds``; see `ProcessHandle`."""
        self._let_go()
        if self.node is not None:
            await asyncio.sleep(min(seconds, self._cluster.random.uniform(*STOPPING_S)))
            self._finish()

    def abandon(self) -> None:
        """Handles the end of the service. The actor ends later, on a stopped node only after the node resumes."""
        self._let_go()
        if self.work is not None:
            self.work.drift()
        if self.node is not None:
            self._cluster.later(LATE_S, self._finish)

    def _let_go(self) -> None:
        self.over = True
        self._placement.drop(self)

    # Called by the node.

    def place(self, node: Node) -> None:
        """Starts the worker on the node that Ray has chosen, as soon as the node can be reached."""
        self.node = node
        self._reach(self._begin)

    def pause(self) -> None:
        """Pauses the work, because the node is stopped."""
        if self.work is not None:
            self.work.pause()

    def resume(self) -> None:
        """Resumes the work, because the node has resumed."""
        if self.work is not None:
            self.work.resume()

    def kill(self) -> None:
        """Ends the work together with the node, before Ray notices."""
        if self.work is not None:
            self.work.end()

    def lost(self) -> None:
        """Handles the loss of the node, as declared by Ray."""
        assert self.node is not None
        if self.work is not None:
            self.work.drift()
        if not self.over:
            self._times.hit(self.needs.scene, "node", self.node.failed_at, self._kind)
            began = self.work is not None
            why = "the worker's node was lost" if began else "the worker's actor exited: its node was lost"
            self._cluster.later(TOLD_S, lambda: self._tell_end(ProcessExit(None, why, lost=began)))

    def die(self) -> None:
        """Kills the worker. Its node continues."""
        assert self.work is not None
        self.work.end()
        self._times.hit(self.needs.scene, "worker", self._cluster.loop.time(), self._kind)
        self._gone()

    def _begin(self) -> None:
        if self.over:
            self._finish()
            return
        self._times.place(self.needs.scene, self._kind)
        longest = LONGEST_SHARE * self._placement.between_s
        folder, scene = self._spec.folder.states, self.needs.scene
        frames = self._placement.frames
        self.work = Work(self._cluster, frames, scene, folder, self._number, longest, self._say, self._gone)

    def _gone(self) -> None:
        """Handles the end of a worker that exited on its own."""
        assert self.node is not None
        if self.over:
            self._cluster.give(self.node, self)
        else:
            self._last_message = self._pass(lambda: self._tell_end(ProcessExit(-signal.SIGKILL)), self._last_message)

    def _finish(self) -> None:
        """Ends the worker on its node, as soon as the node can be reached."""
        assert self.node is not None
        if self.node.state in (NodeState.STOPPED, NodeState.CUT) and self.node.listed:
            self.node.held.append(self._finish)
        elif self.node.state is NodeState.RUNNING:
            if self.work is not None:
                self.work.end()
            self._cluster.give(self.node, self)

    # Messages.

    def _say(self, message: Any) -> None:
        self._last_message = self._pass(lambda: self._deliver(message), self._last_message)

    def _deliver(self, message: Any) -> None:
        if not self.over:
            self._on_message(message)

    def _pass(self, call: Callable[[], None], after: float) -> float:
        """Schedules a network call no earlier than the time ``after``, and returns the scheduled time."""
        loop = self._cluster.loop
        due = max(after, loop.time() + self._cluster.random.uniform(*MESSAGE_S))
        loop.call_at(due, self._reach, call)
        return due

    def _reach(self, call: Callable[[], None]) -> None:
        assert self.node is not None
        if self.node.state is NodeState.RUNNING and self.node.listed:
            call()
        elif self.node.listed:
            self.node.held.append(call)

    def _explain(self) -> None:
        if not self.over and self.work is None:
            self._on_message(WaitsForNode(f"the worker is waiting for a node with {self.needs.describe()}"))

    def _tell_end(self, why: ProcessExit) -> None:
        if not self.over:
            self._let_go()
            if self.node is not None and (self.node.state is NodeState.DEAD or self.work is None or not why.lost):
                self._cluster.give(self.node, self)
            self._on_end(why)


class SimulatedPlacement(Placement):
    """Starts workers on the modelled cluster for one service instance.

    Args:
        cluster: the modelled cluster.
        frames: record of the frames.
        times: record of placement and recovery times.
        needs: function that returns the resource needs of a scene's worker.
        between_s: seconds between the frames of a scene.
    """

    fenced = True

    def __init__(
        self,
        cluster: SimulatedCluster,
        frames: FrameRecord,
        times: TimeRecord,
        needs: Callable[[SceneSpec], ResourceNeeds],
        between_s: float,
    ) -> None:
        super().__init__()
        self.simulated = cluster
        self.frames, self.times = frames, times
        self.between_s = between_s
        self.processes: dict[str, dict[SimulatedProcess, None]] = {}
        self._needs = needs
        self._endings: set[asyncio.Task[None]] = set()

    def start(
        self, entry: Entry, spec: Any, on_message: Callable[[Any], None], on_end: Callable[[ProcessExit], None]
    ) -> ProcessHandle:
        """Creates the worker process of a scene, which waits for a place; see `Placement`."""
        assert isinstance(spec, SceneSpec)
        needs = replace(self._needs(spec), scene=spec.folder.name)
        process = SimulatedProcess(self, needs, spec, on_message, on_end)
        self.processes.setdefault(needs.scene, {})[process] = None
        return process

    def ending(self, stop: Coroutine[Any, Any, None]) -> None:
        """Keeps a reference to the task that stops the worker of an ending scene."""
        task = self.simulated.loop.create_task(stop)
        self._endings.add(task)
        task.add_done_callback(self._endings.discard)

    def drop(self, process: SimulatedProcess) -> None:
        """Removes a process that has ended or was given up."""
        self.processes.get(process.needs.scene, {}).pop(process, None)

    def working(self) -> list[SimulatedProcess]:
        """Returns the processes on running nodes that the service has not given up."""
        return [
            process
            for node in self.simulated.running()
            for process in node.processes
            if isinstance(process, SimulatedProcess) and process.work is not None and not process.over
        ]

    def abandon(self) -> None:
        """Abandons all processes, because the service has ended."""
        for processes in tuple(self.processes.values()):
            for process in tuple(processes):
                process.abandon()
