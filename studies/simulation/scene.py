"""A scene of the simulated service: acknowledges frames, sends them to the worker one by one, and counts reports."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from server.background import Background
from server.messages import FrameCommitted, FrameReady, Ready, SceneSpec, WaitsForNode
from server.processes.placement import STOP_SECONDS, ProcessExit
from server.updates.worker_process import WorkerProcess
from studies.simulation.delays import JOURNAL_S
from studies.simulation.process import SimulatedPlacement
from studies.simulation.work import frame_file, listed, read_frame


@dataclass(frozen=True, eq=False)
class ScenePlan:
    """A user's requests for a scene.

    Attributes:
        spec: scene specification.
        kind: kind of its worker's resource needs.
        frames: times at which its frames are sent, in seconds.
        ends: time from which the scene may end, once all its frames are committed; None if it does not end.
    """

    spec: SceneSpec
    kind: int
    frames: Sequence[float]
    ends: float | None = None

    @property
    def name(self) -> str:
        """Id of the scene."""
        return self.spec.folder.name


class SimulatedScene:
    """Replacement for `server.updates.updates.Updates` in one service instance.

    Attributes:
        plan: requests for the scene.
        worker: the service's own supervision of the worker.
        trouble: error that the scene's status shows.
        ended: whether a user has ended the scene.
    """

    def __init__(self, plan: ScenePlan, placement: SimulatedPlacement, reason: str) -> None:
        self.plan = plan
        self.trouble: str | None = None
        self.ended = False
        self._placement = placement
        self._frames, self._times = placement.frames, placement.times
        self._random = placement.simulated.random
        self._loop = asyncio.get_running_loop()
        self._background = Background(_fail)
        self._at: int | None = None
        self._committed = 0
        self._next: asyncio.TimerHandle | None = None
        self._dead = False
        self._frames.acknowledged.setdefault(plan.name, 0)
        self._recover()
        self.worker = WorkerProcess(plan.spec, placement)
        self.worker.listen(self._from_worker, self._worker_ended)
        self._times.want(plan.name, reason, plan.kind)
        self.worker.start()
        self._expect()
        if plan.ends is not None:
            self._loop.call_at(max(plan.ends, self._loop.time()), self._end_if_done)

    @property
    def done(self) -> bool:
        """Whether all frames are committed, as far as the service knows."""
        return self._committed == len(self.plan.frames)

    def kill(self) -> None:
        """Detaches the scene from a service that has ended."""
        self._dead = True
        self.worker.close()
        self._background.cancel()
        if self._next is not None:
            self._next.cancel()

    def _recover(self) -> None:
        """Reads which frames are committed, as a service does on startup."""
        states = self.plan.spec.folder.states
        if states.exists():
            self._learn(len(listed(states)))

    def _learn(self, count: int) -> None:
        """Reports the first `count` frames. The worker that wrote them is read through the link, as by a client."""
        for index in self._frames.untold(self.plan.name, count):
            try:
                worker = read_frame(frame_file(self.plan.spec.folder.states, index)).worker
            except FileNotFoundError:  # reported but unreadable: no worker has this number
                worker = 0
            self._frames.report(self.plan.name, index, worker)
        self._committed = count

    # Frames.

    def _expect(self) -> None:
        acknowledged = self._frames.acknowledged[self.plan.name]
        if acknowledged < len(self.plan.frames):
            when = max(self.plan.frames[acknowledged], self._loop.time())
            self._next = self._loop.call_at(when, self._acknowledge)

    def _acknowledge(self) -> None:
        self._frames.acknowledged[self.plan.name] += 1
        self._begin()
        self._expect()

    def _begin(self) -> None:
        if self._at is not None or self._committed >= self._frames.acknowledged[self.plan.name]:
            return
        if not self.worker.ready:
            self.worker.start()
            return
        self._at = self._committed
        self.worker.send(FrameReady(self._at, float(self._at), (), ""))

    def _end_if_done(self) -> None:
        over = self.plan.ends is not None and self._loop.time() >= self.plan.ends
        if over and self.done and not self._dead:
            self.kill()
            self.ended = True
            self._times.drop(self.plan.name)
            self._placement.ending(self.worker.stop(STOP_SECONDS))

    # The worker.

    def _from_worker(self, message: Any) -> None:
        match message:
            case Ready():
                self._background.run(self._resume(message, self.worker.life))
            case FrameCommitted():
                self.worker.deaths.note_commit()
                self._frames.report(self.plan.name, message.index, message.report["worker"])
                self._committed, self._at = message.index + 1, None
                self._begin()
                self._end_if_done()
            case WaitsForNode():
                self.trouble = message.reason
                self._times.explain(self.plan.name)

    async def _resume(self, ready: Ready, life: object) -> None:
        self._learn(len(ready.indices))
        if life is None or life is not self.worker.life:
            return
        self.trouble = None
        self.worker.ready = True
        self._times.resume(self.plan.name, self.plan.kind)
        self._begin()
        self._background.run(self.worker.remove_earlier_epochs(), endless=True)
        self._end_if_done()

    def _worker_ended(self, reason: ProcessExit) -> None:
        self._times.want(self.plan.name, "loss", self.plan.kind)
        _, delay = self.worker.deaths.note_death(reason)
        self.trouble = f"the worker is gone: {reason}"
        self._background.run(self._after_death(reason, delay))

    async def _after_death(self, reason: ProcessExit, delay: float) -> None:
        index, self._at = self._at, None
        if index is not None and not reason.lost:
            await asyncio.sleep(self._random.uniform(*JOURNAL_S))
        self.worker.start_in(delay)


def _fail(error: BaseException) -> None:
    raise error
