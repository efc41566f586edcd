"""Replays of a scene: repetitions of its newest updates with other numbers of iterations.

Replays measure the trade-off between accuracy and time. They run one at a time, and their results
are kept in memory.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping
from typing import Any

from client.wire import PointKind, ReplayRequest, ReplayState, ReplayStatus, TradeoffPoint
from scas4d_core.errors import message_of
from server.messages import DamageFound, FrameReady, ReplayPoint, ReplaySpec, ReplayUpdated, SceneSpec
from server.problems import Problem, count_noun
from server.processes import replayer
from server.processes.background_job import wait_for_job
from server.processes.placement import Placement
from server.scene.status import effective_budget
from server.storage.ledger import Ledger

KEPT = 32
"""Maximum number of trade-off points to keep; the oldest measurements are dropped."""

log = logging.getLogger("scas4d.server")


class Replays:
    """Replays of one scene.

    Args:
        spec: scene specification.
        ledger: the scene's ledger.
        placement: placement used to start the replay processes.
        damaged: callback for unreadable files; receives the reason for each, keyed by file name.

    Attributes:
        status: status of the newest replay.
        points: latest measurement for each number of iterations. The times exclude writing the commit.
    """

    def __init__(
        self,
        spec: SceneSpec,
        ledger: Ledger,
        placement: Placement,
        damaged: Callable[[Mapping[str, str]], None],
    ) -> None:
        self._spec = spec
        self._ledger = ledger
        self._placement = placement
        self._damaged = damaged
        self._task: asyncio.Task[None] | None = None
        self.status = ReplayStatus()
        self.points: dict[int, TradeoffPoint] = {}

    @property
    def busy(self) -> bool:
        """Whether a replay is running."""
        return self._task is not None and not self._task.done()

    def start(self, request: ReplayRequest) -> None:
        """Starts a replay in a separate process.

        Raises:
            Problem: 409 if a replay is already running, or if the frames, their images or the preceding state are not
                available.
        """
        id = self._ledger.scene
        if self.busy:
            raise Problem(
                409,
                f"a replay is already running: {self.status.done} of {count_noun(self.status.total, 'update')}",
                field="id",
                value=id,
                remedy=f"wait for it; GET /v1/scenes/{id}/tradeoff reports its progress",
            )
        base, indices = self._chosen(request.frames)
        own = self._own_iterations()
        iterations = tuple(dict.fromkeys([own, *request.iterations]))
        messages = tuple(self._message(index) for index in indices)
        spec = ReplaySpec(self._spec, self._ledger.committed[0], base, messages, iterations)
        self.status = ReplayStatus(
            state=ReplayState.RUNNING,
            iterations=list(iterations),
            frames=indices[1:],
            warm_up=indices[0],
            threads=replayer.THREADS,
            total=len(iterations) * len(indices),
        )
        self._task = asyncio.create_task(self._run(spec))

    def _chosen(self, count: int) -> tuple[int, list[int]]:
        """Chooses the frames of a replay of `count` measured updates.

        Returns:
            The committed frame whose state the replay starts from, and the frames to replay. The
            first of them warms up the process and is not measured.

        Raises:
            Problem: 409 if the states or images are not available.
        """
        committed, frames = self._ledger.committed, self._ledger.frames
        if len(committed) < count + 2:
            raise Problem(
                409,
                f"{count_noun(len(committed), 'committed state')} available, but {count + 2} are needed: one to start "
                f"from, one to warm up, and {count_noun(count, 'frame')} to measure",
                field="frames",
                value=count,
                remedy="try again when more frames are committed, or request fewer frames (ingest.keep_states sets how "
                "many states are kept)",
            )
        base, indices = committed[-count - 2], list(committed[-count - 1 :])
        gone = [index for index in range(base + 1, indices[-1]) if frames[index].deleted]
        if gone:
            raise Problem(
                409,
                f"the state of frame {gone[-1]} was deleted, so the last {len(indices)} frames cannot be replayed",
                field="frames",
                value=count,
                remedy="request fewer frames, or create scenes that keep more states (ingest.keep_states)",
            )
        bare = [index for index in indices if not frames[index].files]
        if bare:
            held = len(indices) - 1 - indices.index(bare[-1])
            raise Problem(
                409,
                f"the images of frame {bare[-1]} were deleted",
                field="frames",
                value=count,
                remedy=(f"request at most {count_noun(held - 1, 'frame')}, or " if held > 1 else "")
                + "create scenes that keep more images (ingest.keep_frames)",
            )
        return base, indices

    def _own_iterations(self) -> int:
        """Returns the number of iterations that the scene currently runs per update.

        This is the number in the budget or, under a time budget, the number that the latest update reached. Degraded
        frames are ignored.
        """
        budget = effective_budget(self._spec.settings, self._ledger.budgets[-1][1])
        if budget.budget_ms is not None:
            for index in reversed(self._ledger.committed[1:]):
                report = self._ledger.frames[index].report
                if report.iterations is None:  # the commit record is no longer in memory
                    break
                if report.iterations and report.degraded is None:
                    return report.iterations
        return budget.iterations

    def _message(self, index: int) -> FrameReady:
        entry = self._ledger.frames[index]
        receipt = entry.receipt
        assert receipt is not None  # always set for a frame with files
        return FrameReady(index, receipt.time, entry.files, receipt.identity)

    async def _run(self, spec: ReplaySpec) -> None:
        """Runs the replay process and records the outcome."""
        try:
            fault = await wait_for_job(self._placement, replayer.main, spec, self._on_message, "replay")
        except Exception as error:
            log.exception("scene %s: a replay failed", self._ledger.scene)
            fault = f"internal error: {type(error).__name__}: {message_of(error)}"
        else:
            if fault is not None:
                log.error("scene %s: a replay failed: %s", self._ledger.scene, fault)
        self.status.state = ReplayState.DONE if fault is None else ReplayState.FAILED
        self.status.error = fault

    def _on_message(self, message: Any) -> None:
        match message:
            case DamageFound():
                self._damaged(message.files)
            case ReplayUpdated():
                self.status.done += 1
            case ReplayPoint():
                self.points.pop(message.iterations, None)
                while len(self.points) >= KEPT:
                    del self.points[next(iter(self.points))]
                self.points[message.iterations] = TradeoffPoint(
                    kind=PointKind.REPLAYED,
                    iterations=message.iterations,
                    milliseconds=message.milliseconds,
                    error=message.error,
                    psnr=message.psnr,
                    frames=message.frames,
                    threads=replayer.THREADS,
                )

    async def end(self) -> None:
        """Stops the running replay, if any, at a client's request and keeps the points measured so far."""
        if not self.busy:
            return
        await self.stop()
        self.status.state, self.status.error = ReplayState.FAILED, "the replay was stopped on request"

    async def stop(self) -> None:
        """Stops the running replay, if any, because the scene is stopping."""
        if self._task is not None and not self._task.done():
            self._task.cancel()
            await asyncio.wait({self._task})
