"""Gives queued frames to the scene's worker, one at a time, and records what becomes of each. On the event loop."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from client.wire import FrameReportModel, FrameState, ProgressModel, Retention
from server.health import metrics
from server.processes import worker
from server.processes.messages import (
    Broken,
    FrameCommitted,
    FrameFailed,
    FrameReady,
    Mended,
    Progressed,
    Ready,
    SceneSpec,
    Stalled,
)
from server.processes.placement import Ended, Placement, Process
from server.processes.readers import Readers
from server.repair.mending import DamageKind, DamageLog, Mending
from server.scene.status import FrameReports
from server.scene.supervision import Background, WorkClock, WorkerDeaths, given_up
from server.storage.events import FrameSetAside, PicturesDeleted, StatesDeleted, WorkerDied
from server.storage.ledger import SceneLog
from server.stream.hub import Event, FrameFinished, SceneChanged

log = logging.getLogger("scas4d.server")


class Updates:
    """The updates of one scene, and the worker that runs them.

    Args:
        scene_log, spec, damage, readers, reports, background: of the scene.
        keep_frames: rule of retention for pictures.
        tell: publishes an event to the scene's subscribers.
        close_due: closes open frames for which there may be room now.
        remake: frames whose states were found damaged at the start, with the reason.

    Attributes:
        trouble: why the scene is degraded: a sentence about the last frame, the worker or the disk, or None.
        progress: of frame 0, while it is at work. gaussians: in the newest state, where it is known.
        first: what of the first frame's report matters later: its cloud and its calibration.
    """

    def __init__(
        self,
        scene_log: SceneLog,
        spec: SceneSpec,
        damage: DamageLog,
        readers: Readers,
        reports: FrameReports,
        background: Background,
        placement: Placement,
        *,
        keep_frames: Retention,
        publish: Callable[[Event], None],
        close_due: Callable[[], Awaitable[None]],
        remake: Mapping[int, str],
    ) -> None:
        self._log = scene_log
        self._ledger = scene_log.ledger
        self._spec = spec
        self._damage = damage
        self._readers = readers
        self._reports = reports
        self._background = background
        self._placement = placement
        self._keep_frames = keep_frames
        self._publish = publish
        self._close_due = close_due
        self.clock = WorkClock()
        self.deaths = WorkerDeaths()
        self.trouble = self._last_trouble()
        self.progress: ProgressModel | None = None
        self.gaussians: int | None = None
        self.first: Mapping[str, Any] = {}
        self._index: int | None = None
        self._ready = False
        self._holding = 0
        self._stopping = False
        self._restart: asyncio.TimerHandle | None = None
        self.mending = Mending(
            self._ledger,
            damage,
            to_worker=self._to_worker,
            changed=self._states_changed,
            journal=lambda event: background.run(scene_log.write(event)),
            remake=remake,
        )
        self._worker: Process
        self._start_worker()

    def tell(self, event: Event) -> None:
        """Counts and publishes an event; to be called at every change of the scene's status or of a frame."""
        if isinstance(event, FrameFinished):
            report = event.report
            metrics.FRAMES.labels(report.state.value).inc()
            if report.state == FrameState.COMMITTED:
                metrics.LEFT_OUT.inc(len(report.dropped_cameras))
                for alarm in report.alarms:
                    metrics.ALARMS.labels(alarm.what.value).inc()
                if report.outcome is not None and report.outcome.degraded:
                    metrics.DEGRADED.labels("held" if report.outcome.held else "in_part").inc()
            for stage, seconds in report.seconds.items():
                metrics.UPDATE_SECONDS.labels(stage).observe(seconds)
        self._publish(event)

    @property
    def at_work(self) -> bool:
        """True while the worker has a frame."""
        return self._index is not None and self._ready

    def begin(self) -> None:
        """Gives the worker its next frame, if it is idle and one waits; to be called whenever that may have changed."""
        self.tell(SceneChanged())
        ledger = self._ledger
        busy = self._index is not None or self._holding or self.mending.at_work is not None
        if not self._ready or self._stopping or busy:
            return
        waiting = [] if ledger.paused or ledger.fatal is not None else ledger.waiting()
        if not waiting:
            if self.mending.waiting:
                self.mending.begin()
            return
        index = waiting[0]
        entry = ledger.frames[index]
        receipt = entry.receipt
        assert receipt is not None
        ledger.move(index, FrameState.UPDATING)
        self._index = index
        self.clock.begin(first=not ledger.committed)
        self._worker.send(FrameReady(index, receipt.time, entry.files, receipt.identity, ledger.budget_of(index)))
        self.tell(SceneChanged())

    @contextmanager
    def held(self) -> Iterator[None]:
        """Gives the worker no frame inside; the one at work goes on."""
        self._holding += 1
        try:
            yield
        finally:
            self._holding -= 1
            self.begin()

    # Messages of the worker.

    def _from_worker(self, message: Any) -> None:
        match message:
            case Ready():
                self._background.run(self._resume(message))
            case Progressed():
                self.progress = ProgressModel(
                    stage=message.stage, done=message.done, total=message.total, detail=message.detail
                )
                self.clock.progress(message.stage, message.done, message.total, message.detail.get("seconds_left"))
                self.tell(SceneChanged())
            case FrameCommitted():
                self._background.run(self._commit(message))
            case FrameFailed():
                event = FrameSetAside(
                    index=message.index, reason=message.reason, dropped=message.dropped, fatal=message.fatal
                )
                self._background.run(self._set_aside(event))
            case Mended():
                self.mending.mended(message)
                if not self.first:  # it could not be read before
                    self._background.run(self.recall())
            case Stalled():
                self.trouble = f"frame {message.index} waits for room on the disk: {message.reason}"
                self.clock.stall(message.seconds)
                self.tell(SceneChanged())
            case Broken():
                self._ledger.fatal = f"what is committed cannot be gone on from: {message.reason}"
                log.error("scene %s: %s", self._ledger.scene, self._ledger.fatal)
                self.tell(SceneChanged())

    async def _resume(self, ready: Ready) -> None:
        """Brings the ledger in line with the committed states that a new worker has loaded, and goes on."""
        ledger = self._ledger
        newest = ledger.committed[-1] if ledger.committed else -1
        again = self.mending.waiting.keys() | {i for i in ready.damaged if i < max(ready.indices, default=-1)}
        events = ledger.reconcile(ready.indices, ready.damaged, again)
        for fault in ready.faults:
            log.warning("scene %s: %s", ledger.scene, fault)
            self._damage.say(DamageKind.STATE, fault)
        if events:
            await self._log.write(*events)
        if ready.indices and ready.report:
            self._record(ready.indices[-1], ready.report)
            self._readers.refresh()
            if ready.indices[-1] > newest:  # committed by a worker that died before it could say so
                self.tell(FrameFinished(ledger.frames[ready.indices[-1]].report))
        self.trouble = self._last_trouble()
        self._ready = True
        self.mending.taken_up(ready.damaged)
        self.begin()

    async def _commit(self, message: FrameCommitted) -> None:
        self.deaths.committed()
        self.clock.end(committed=True)
        self._index, self.progress = None, None
        self._ledger.move(message.index, FrameState.COMMITTED)
        self._record(message.index, message.report)
        report = self._ledger.frames[message.index].report
        self.trouble = trouble_of(report)
        self._readers.refresh((message.index, *message.deleted))
        self.tell(FrameFinished(report))
        self.begin()
        if message.deleted:
            self.mending.retired(message.deleted)
            deleted = StatesDeleted(frames=message.deleted)
            self._ledger.apply(deleted)
            self.tell(SceneChanged())
            await self._log.write(deleted)
        await self.retain()
        if self._ledger.open:
            await self._close_due()

    async def _set_aside(self, event: FrameSetAside) -> None:
        await self._log.write(event)
        self._ledger.apply(event)
        self.clock.end(committed=False)
        self._index, self.progress = None, None
        self.trouble = trouble_of(self._ledger.frames[event.index].report)
        if event.fatal:
            async with self._log.lock:  # a frame that is just being acknowledged waits like the others
                pass
            await self._fail_waiting()
        log.warning("scene %s: %s", self._ledger.scene, self.trouble)
        self.tell(FrameFinished(self._ledger.frames[event.index].report))
        self.begin()
        if self._ledger.open:
            await self._close_due()

    async def _fail_waiting(self) -> None:
        events = self._ledger.hopeless()
        if events:
            await self._log.write(*events)
        for event in events:
            self._ledger.apply(event)
            self.tell(FrameFinished(self._ledger.frames[event.index].report))

    def _record(self, index: int, record: Mapping[str, Any]) -> None:
        self._ledger.frames.set_record(index, record)
        self.gaussians = record.get("gaussians")
        self._recall(record)

    def _recall(self, record: Mapping[str, Any]) -> None:
        """Keeps what the report of the first frame alone has."""
        if record.get("cloud") or record.get("calibration"):
            self.first = {name: record.get(name) for name in ("cloud", "calibration", "shortened", "grey")}

    async def recall(self) -> None:
        """Reads the first report of a scene that is found again; to be called before anybody asks for it."""
        if self._ledger.committed:
            self._recall(await self._reports.record(self._ledger.committed[0]))

    def _last_trouble(self) -> str | None:
        """Returns what went wrong with the newest frame that was tried, or None."""
        last = self._ledger.last_tried()
        return None if last is None else trouble_of(self._ledger.frames[last].report)

    async def retain(self) -> None:
        """Deletes pictures from the frame log by the scene's rule, except those needed to make states again."""
        gone = [i for i in self._log.deletable(self._keep_frames) if i not in self.mending.waiting]
        if not gone:
            return
        names = [name for index in gone for name in self._ledger.frames[index].files]
        event = PicturesDeleted(frames=tuple(gone))
        self._ledger.apply(event)
        self.tell(SceneChanged())
        await self._log.delete_pictures(names)
        await self._log.write(event)

    # Mending.

    def _to_worker(self, message: Any) -> bool:
        """Posts a message; returns False where no worker can receive one."""
        if self._ready:
            self._worker.send(message)
        return self._ready

    def _states_changed(self, frames: tuple[int, ...]) -> None:
        if frames:
            self._readers.refresh(frames)
        self.begin()

    # The worker's life.

    def _start_worker(self) -> None:
        self.deaths.started()
        self._worker = self._placement.start(worker.main, self._spec, self._from_worker, self._worker_ended)

    def _worker_ended(self, reason: Ended) -> None:
        self._ready, self.progress = False, None
        self.clock.end(committed=False)
        if self._stopping or self._ledger.fatal is not None:
            return
        metrics.RESTARTS.labels("worker").inc()
        own, delay = self.deaths.died(reason.exit_code)
        self.trouble = f"the worker is gone: {reason}; it is started again in {delay:g} s"
        log.error("scene %s: %s", self._ledger.scene, self.trouble)
        self._background.run(self._after_death(str(reason), own, delay))

    async def _after_death(self, reason: str, own: bool, delay: float) -> None:
        index, self._index = self._index, None
        if index is not None and self._ledger.frames[index].state == FrameState.UPDATING:
            self._ledger.move(index, FrameState.QUEUED)
            death = WorkerDied(index=index, reason=reason, own=own)
            await self._log.write(death)
            self._ledger.apply(death)
            # The worker may have died after its commit and before its message: then the next worker tells of it.
            event = given_up(self._ledger.frames[index], death)
            if event is not None and not await self._reports.is_committed(index):
                await self._set_aside(event)
        self.tell(SceneChanged())
        if not self._stopping:
            self._restart = asyncio.get_running_loop().call_later(delay, self._start_worker)

    def stop(self) -> None:
        """Starts no worker again, and tries no mending again."""
        self._stopping = True
        if self._restart is not None:
            self._restart.cancel()
        self.mending.stop()

    async def stop_worker(self, seconds: float) -> None:
        """Ends the worker, which has `seconds` to do so itself; an unfinished frame is updated again after the next."""
        await self._worker.stop(seconds)


def trouble_of(report: FrameReportModel) -> str | None:
    """Says why a scene is degraded whose newest finished frame has this report; None: it is not."""
    if report.state == FrameState.SET_ASIDE:
        return f"frame {report.index} was set aside: {report.error}"
    if report.outcome is not None and report.outcome.degraded:
        verb = "" if report.outcome.held else "committed in part: "
        return f"frame {report.index} was {verb}{report.degraded}"
    if report.dropped_cameras:
        left_out = "; ".join(f"{name}: {reason}" for name, reason in report.dropped_cameras.items())
        return f"frame {report.index} was committed without camera {left_out}"
    return None
