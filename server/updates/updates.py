"""Gives queued frames to the scene's worker, one at a time, and records what becomes of each. On the event loop."""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from client.wire import FrameState, IngestSettings, ProgressModel, Retention
from server import counters
from server.background import Background
from server.hub import Event, FrameFinished, SceneChanged
from server.messages import (
    Broken,
    FrameCommitted,
    FrameFailed,
    FrameReady,
    KeepStates,
    Mended,
    Progressed,
    Ready,
    SceneSpec,
    Stalled,
    StatesRetained,
    WaitsForNode,
)
from server.processes.kernels import STAGE
from server.processes.placement import Ended, Placement
from server.processes.readers import Readers
from server.repair.mending import DamageKind, DamageLog, Mending
from server.storage.events import FrameSetAside, PicturesDeleted, StatesDeleted, WorkerDied
from server.storage.ledger import SceneLog
from server.updates.reports import FrameReports, last_trouble, of_first_report, trouble_of
from server.updates.work_clock import WorkClock
from server.updates.worker_process import WorkerProcess, given_up

log = logging.getLogger("scas4d.server")


class Updates:
    """The updates of one scene, and the worker that runs them.

    Args:
        scene_log, spec, damage, readers, reports, background: of the scene.
        keep_frames: rule of retention for pictures.
        tell: publishes an event to the scene's subscribers.
        close_due: closes open frames for which there may be room now.
        remake: frames whose states were found damaged at the start, with the reason.
        first: see below.

    Attributes:
        trouble: why the scene is degraded: a sentence about the last frame, the worker or the disk, or None.
        progress: of frame 0, while it is at work. worker: its process.
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
        first: Mapping[str, Any],
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
        self.worker = WorkerProcess(spec, placement, self._from_worker, self._worker_ended)
        self.trouble = last_trouble(self._ledger)
        self.progress: ProgressModel | None = None
        self.first = first
        self._index: int | None = None
        self._holding = 0
        self._rule: IngestSettings | None = None
        """For states, that the worker has not said it keeps."""
        self._told = False
        self.mending = Mending(
            self._ledger,
            damage,
            to_worker=self.worker.send,
            changed=self._states_changed,
            journal=lambda event: background.run(scene_log.write(event)),
            remake=remake,
        )

    def tell(self, event: Event) -> None:
        """Counts and publishes an event; to be called at every change of the scene's status or of a frame."""
        if isinstance(event, FrameFinished):
            report = event.report
            counters.FRAMES.labels(report.state.value).inc()
            if report.state == FrameState.COMMITTED:
                counters.LEFT_OUT.inc(len(report.dropped_cameras))
                for alarm in report.alarms:
                    counters.ALARMS.labels(alarm.what.value).inc()
                if report.outcome is not None and report.outcome.degraded:
                    counters.DEGRADED.labels("held" if report.outcome.held else "in_part").inc()
            for stage, seconds in report.seconds.items():
                counters.UPDATE_SECONDS.labels(stage).observe(seconds)
        self._publish(event)

    @property
    def at_work(self) -> bool:
        """True while the worker has a frame."""
        return self._index is not None and self.worker.ready

    @property
    def has_work(self) -> bool:
        """True while a frame is at work or waits, or something is mended or will be."""
        mending = self.mending.at_work is not None or self.mending.trouble is not None
        waits = bool(self._holding or self._waiting()) or self._rule is not None or self.worker.starts_again
        return self._index is not None or waits or mending

    def _waiting(self) -> list[int]:
        ledger = self._ledger
        return [] if ledger.paused or ledger.fatal is not None else ledger.waiting()

    def begin(self) -> None:
        """Gives the worker its next frame, if it is idle and one waits; to be called whenever that may have changed."""
        self.tell(SceneChanged())
        ledger = self._ledger
        if self._index is not None or self._holding or self.mending.at_work is not None:
            return
        waiting = self._waiting()
        if not self.worker.ready:
            if waiting or self.mending.trouble is not None or self._rule is not None:
                self.worker.start()
            return
        if self._rule is not None and not self._told:
            self._told = self.worker.send(KeepStates(self._rule))
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
        self.worker.send(FrameReady(index, receipt.time, entry.files, receipt.identity, ledger.budget_of(index)))
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
                self._background.run(self._resume(message, self.worker.life))
            case Progressed():
                over = message.stage == STAGE and message.done == message.total  # an update tells no other stage
                self.progress = None if over else ProgressModel(**vars(message))
                self.clock.progress(message.stage, message.done, message.total, message.detail.get("seconds_left"))
                self.tell(SceneChanged())
            case FrameCommitted():
                self._background.run(self._commit(message))
            case StatesRetained():
                self._rule = None
                self._background.run(self._states_deleted(message.deleted))
            case FrameFailed():
                event = FrameSetAside(
                    index=message.index, reason=message.reason, dropped=message.dropped, fatal=message.fatal
                )
                self._background.run(self._set_aside(event))
            case Mended():
                self.mending.mended(message)
                if not self.first:  # it could not be read before
                    self._background.run(self._recall())
            case Stalled():
                self.trouble = f"frame {message.index} waits for room on the disk: {message.reason}"
                self.clock.stall(message.seconds)
                self.tell(SceneChanged())
            case WaitsForNode():
                self.trouble = message.reason
                self.tell(SceneChanged())
            case Broken():
                self._ledger.fatal = f"what is committed cannot be gone on from: {message.reason}"
                log.error("scene %s: %s", self._ledger.scene, self._ledger.fatal)
                self.tell(SceneChanged())

    async def _resume(self, ready: Ready, life: object) -> None:
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
        if life is None or life is not self.worker.life:  # it died meanwhile
            return
        self.trouble = last_trouble(self._ledger)
        self.worker.ready = True
        self.mending.taken_up(ready.damaged)
        self.begin()
        self._background.run(self.worker.sweep(), endless=True)

    async def _commit(self, message: FrameCommitted) -> None:
        self.worker.deaths.committed()
        self.clock.end(committed=True)
        self._index, self.progress = None, None
        self._ledger.move(message.index, FrameState.COMMITTED)
        self._record(message.index, message.report)
        report = self._ledger.frames[message.index].report
        self.trouble = trouble_of(report)
        self._readers.refresh((message.index,))
        self.tell(FrameFinished(report))
        self.begin()
        await self._states_deleted(message.deleted)
        await self.retain()
        if self._ledger.open:
            await self._close_due()

    async def _states_deleted(self, frames: tuple[int, ...]) -> None:
        if frames:
            self.mending.retired(frames)
            self._readers.refresh(frames)
            deleted = StatesDeleted(frames=frames)
            self._ledger.apply(deleted)
            self.tell(SceneChanged())
            await self._log.write(deleted)

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
        self.first = of_first_report(record) or self.first

    async def _recall(self) -> None:
        """Reads the report of the first frame, which could not be read before."""
        if self._ledger.committed:
            self.first = of_first_report(await self._reports.record(self._ledger.committed[0])) or self.first

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

    async def keep(self, rules: IngestSettings) -> None:
        """Keeps so much from now on, and deletes what is beyond it."""
        before = self.worker.spec.kept
        if (rules.keep_states, rules.exact_states) != (before.keep_states, before.exact_states):
            self.worker.spec = replace(self.worker.spec, kept=rules)
            self._rule, self._told = rules, False
            self.begin()
        self._keep_frames = rules.keep_frames
        await self.retain()

    # Mending.

    def _states_changed(self, frames: tuple[int, ...]) -> None:
        if frames:
            self._readers.refresh(frames)
        self.begin()

    # The worker's life.

    def _worker_ended(self, reason: Ended) -> None:
        self.progress, self._told = None, False
        self.clock.end(committed=False)
        if self._ledger.fatal is not None:
            return
        counters.RESTARTS.labels("worker").inc()
        own, delay = self.worker.deaths.died(reason)
        self.trouble = f"the worker is gone: {reason}; it is started again in {delay:g} s"
        log.error("scene %s: %s", self._ledger.scene, self.trouble)
        self._background.run(self._after_death(reason, own, delay))

    async def _after_death(self, reason: Ended, own: bool, delay: float) -> None:
        index, self._index = self._index, None
        if index is not None and self._ledger.frames[index].state == FrameState.UPDATING:
            self._ledger.move(index, FrameState.QUEUED)
            if not reason.lost:  # a machine that is lost is no fault of the frame
                death = WorkerDied(index=index, reason=str(reason), own=own)
                await self._log.write(death)
                self._ledger.apply(death)
                # The worker may have died after its commit and before its message: then the next worker tells of it.
                event = given_up(self._ledger.frames[index], death)
                if event is not None and not await self._reports.is_committed(index):
                    await self._set_aside(event)
        self.tell(SceneChanged())
        self.worker.start_in(delay)

    def stop(self) -> None:
        """Starts no worker again, and tries no mending again."""
        self.worker.close()
        self.mending.stop()
