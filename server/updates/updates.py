"""Gives queued frames to the scene's worker, one at a time, and records what becomes of each. On the event loop."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from client.wire import FrameState, IngestSettings, ProgressModel, Retention
from server import counters
from server.background import Background
from server.hub import Publisher
from server.messages import (
    Broken,
    FrameCommitted,
    FrameReady,
    KeepStates,
    Progressed,
    Ready,
    RepairResult,
    Stalled,
    StatesRetained,
    UpdateFailed,
    WaitsForNode,
)
from server.processes.kernels import STAGE
from server.processes.placement import ProcessExit
from server.processes.readers import Readers
from server.repair.repair_queue import DamageKind, DamageLog, RepairQueue
from server.storage.events import FrameFailed, PicturesDeleted, StatesDeleted, WorkerDied
from server.storage.ledger import SceneLog
from server.updates.reports import FrameReports, of_first_report
from server.updates.trouble import Trouble, last_trouble, trouble_of
from server.updates.work_clock import WorkClock
from server.updates.worker_process import WorkerProcess, given_up

log = logging.getLogger("scas4d.server")


class Updates:
    """The updates of one scene, and the worker that runs them.

    A frame that was acknowledged waits in the ledger. `begin` sends it to the worker as `FrameReady`. The worker
    answers with `FrameCommitted` or `UpdateFailed`, or it dies.
    `_commit`, `_record_failure` and `_after_death` record that.

    Args:
        scene_log, damage, worker, mending, readers, reports, trouble, publisher, background: of the scene.
        keep_frames: rule of retention for pictures.
        first: see below.

    Attributes:
        clock: predicts the end of the frame at work. worker: its process.
        progress: of frame 0, while it is at work.
        first: what of the first frame's report matters later: its cloud and its calibration.
    """

    def __init__(
        self,
        scene_log: SceneLog,
        damage: DamageLog,
        worker: WorkerProcess,
        mending: RepairQueue,
        readers: Readers,
        reports: FrameReports,
        trouble: Trouble,
        publisher: Publisher,
        background: Background,
        *,
        keep_frames: Retention,
        first: Mapping[str, Any],
    ) -> None:
        self._log = scene_log
        self._ledger = scene_log.ledger
        self._damage = damage
        self._repair_queue = mending
        self._readers = readers
        self._reports = reports
        self._trouble = trouble
        self._publisher = publisher
        self._background = background
        self._keep_frames = keep_frames
        self._room_made: Callable[[], Awaitable[None]] | None = None
        self.clock = WorkClock()
        self.worker = worker
        self.progress: ProgressModel | None = None
        self.first = first
        self._index: int | None = None
        self._holding = 0
        self._stopped = False
        self._rule: IngestSettings | None = None
        """The retention rule of states that the worker has not confirmed yet."""
        self._rule_sent = False
        self._repair_timer: asyncio.TimerHandle | None = None
        """Begins again where mending waits for room on the disk."""
        worker.listen(self._from_worker, self._worker_ended)

    def when_room_is_made(self, call: Callable[[], Awaitable[None]]) -> None:
        """Sets the coroutine function that closes open frames once a frame is over and the queue has room."""
        self._room_made = call

    @property
    def at_work(self) -> bool:
        """True while the worker has a frame."""
        return self._index is not None and self.worker.ready

    @property
    def has_work(self) -> bool:
        """True while a frame is at work or waits, or something is mended or will be."""
        mending = self._repair_queue.at_work is not None or self._repair_queue.trouble is not None
        waits = bool(self._holding or self._waiting()) or self._rule is not None or self.worker.starts_again
        return self._index is not None or waits or mending

    def _waiting(self) -> list[int]:
        ledger = self._ledger
        return [] if ledger.paused or ledger.fatal is not None else ledger.waiting()

    def begin(self) -> None:
        """Gives the worker its next frame, if it is idle and one waits; to be called whenever that may have changed."""
        if self._stopped:
            return
        self._publisher.changed()
        ledger = self._ledger
        if self._index is not None or self._holding or self._repair_queue.at_work is not None:
            return
        waiting = self._waiting()
        if not self.worker.ready:
            if waiting or self._repair_queue.trouble is not None or self._rule is not None:
                self.worker.start()
            return
        if self._rule is not None and not self._rule_sent:
            self._rule_sent = self.worker.send(KeepStates(self._rule))
        if not waiting:
            if self._repair_queue.waiting and (seconds := self._repair_queue.begin()) > 0:
                self._begin_in(seconds)
            return
        index = waiting[0]
        entry = ledger.frames[index]
        receipt = entry.receipt
        assert receipt is not None
        ledger.move(index, FrameState.UPDATING)
        self._index = index
        self.clock.begin(first=not ledger.committed)
        self.worker.send(FrameReady(index, receipt.time, entry.files, receipt.identity, ledger.budget_of(index)))
        self._publisher.changed()

    def _begin_in(self, seconds: float) -> None:
        if self._repair_timer is not None:
            self._repair_timer.cancel()
        self._repair_timer = asyncio.get_running_loop().call_later(seconds, self.begin)

    @contextmanager
    def paused(self) -> Iterator[None]:
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
                over = message.stage == STAGE and message.done == message.total  # an update reports no other stage
                self.progress = None if over else ProgressModel(**vars(message))
                self.clock.progress(message.stage, message.done, message.total, message.detail.get("seconds_left"))
                self._publisher.changed()
            case FrameCommitted():
                self._background.run(self._commit(message))
            case StatesRetained():
                self._rule = None
                self._background.run(self._states_deleted(message.deleted))
            case UpdateFailed():
                event = FrameFailed(
                    index=message.index, reason=message.reason, dropped=message.dropped, fatal=message.fatal
                )
                self._background.run(self._record_failure(event))
            case RepairResult():
                frames = self._repair_queue.handle_result(message)
                if frames:
                    self._readers.refresh(frames)
                self.begin()
                if not self.first:  # it could not be read before
                    self._background.run(self._recall())
            case Stalled():
                self.clock.stall(message.seconds)
                self._trouble.report(f"frame {message.index} waits for room on the disk: {message.reason}")
            case WaitsForNode():
                self._trouble.report(message.reason)
            case Broken():
                self._ledger.fatal = f"what is committed cannot be gone on from: {message.reason}"
                log.error("scene %s: %s", self._ledger.scene, self._ledger.fatal)
                self._publisher.changed()

    async def _resume(self, ready: Ready, life: object) -> None:
        """Brings the ledger in line with the committed states that a new worker has loaded, and goes on."""
        ledger = self._ledger
        newest = ledger.committed[-1] if ledger.committed else -1
        again = self._repair_queue.waiting.keys() | {i for i in ready.damaged if i < max(ready.indices, default=-1)}
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
                self._publisher.finished(ledger.frames[ready.indices[-1]].report)
        if life is None or life is not self.worker.life:  # it died meanwhile
            return
        self._trouble.sentence = last_trouble(self._ledger)
        self.worker.ready = True
        self._repair_queue.taken_up(ready.damaged)
        self.begin()
        self._background.run(self.worker.sweep(), endless=True)

    async def _commit(self, message: FrameCommitted) -> None:
        self.worker.deaths.committed()
        self.clock.end(committed=True)
        self._index, self.progress = None, None
        self._ledger.move(message.index, FrameState.COMMITTED)
        self._record(message.index, message.report)
        report = self._ledger.frames[message.index].report
        self._trouble.sentence = trouble_of(report)
        self._readers.refresh((message.index,))
        self._publisher.finished(report)
        self.begin()
        await self._states_deleted(message.deleted)
        await self.retain()
        await self._make_room()

    async def _make_room(self) -> None:
        if self._ledger.open and self._room_made is not None:
            await self._room_made()

    async def _states_deleted(self, frames: tuple[int, ...]) -> None:
        if frames:
            self._repair_queue.retired(frames)
            self._readers.refresh(frames)
            deleted = StatesDeleted(frames=frames)
            self._ledger.apply(deleted)
            self._publisher.changed()
            await self._log.write(deleted)

    async def _record_failure(self, event: FrameFailed) -> None:
        await self._log.write(event)
        self._ledger.apply(event)
        self.clock.end(committed=False)
        self._index, self.progress = None, None
        self._trouble.sentence = trouble_of(self._ledger.frames[event.index].report)
        if event.fatal:
            async with self._log.lock:  # a frame that is just being acknowledged waits like the others
                pass
            await self._fail_waiting()
        log.warning("scene %s: %s", self._ledger.scene, self._trouble.sentence)
        self._publisher.finished(self._ledger.frames[event.index].report)
        self.begin()
        await self._make_room()

    async def _fail_waiting(self) -> None:
        events = self._ledger.hopeless()
        if events:
            await self._log.write(*events)
        for event in events:
            self._ledger.apply(event)
            self._publisher.finished(self._ledger.frames[event.index].report)

    def _record(self, index: int, record: Mapping[str, Any]) -> None:
        self._ledger.frames.set_record(index, record)
        self.first = of_first_report(record) or self.first

    async def _recall(self) -> None:
        """Reads the report of the first frame, which could not be read before."""
        if self._ledger.committed:
            self.first = of_first_report(await self._reports.record(self._ledger.committed[0])) or self.first

    async def retain(self) -> None:
        """Deletes pictures from the frame log by the scene's rule, except those needed to make states again."""
        gone = [i for i in self._log.deletable(self._keep_frames) if i not in self._repair_queue.waiting]
        if not gone:
            return
        names = [name for index in gone for name in self._ledger.frames[index].files]
        event = PicturesDeleted(frames=tuple(gone))
        self._ledger.apply(event)
        self._publisher.changed()
        await self._log.delete_pictures(names)
        await self._log.write(event)

    async def keep(self, rules: IngestSettings) -> None:
        """Keeps so much from now on, and deletes what is beyond it."""
        before = self.worker.spec.kept
        if (rules.keep_states, rules.exact_states) != (before.keep_states, before.exact_states):
            self.worker.spec = replace(self.worker.spec, kept=rules)
            self._rule, self._rule_sent = rules, False
            self.begin()
        self._keep_frames = rules.keep_frames
        await self.retain()

    # The worker's life.

    def _worker_ended(self, reason: ProcessExit) -> None:
        self.progress, self._rule_sent = None, False
        self.clock.end(committed=False)
        if self._ledger.fatal is not None:
            return
        counters.RESTARTS.labels("worker").inc()
        own, delay = self.worker.deaths.died(reason)
        self._trouble.sentence = f"the worker is gone: {reason}; it is started again in {delay:g} s"
        log.error("scene %s: %s", self._ledger.scene, self._trouble.sentence)
        self._background.run(self._after_death(reason, own, delay))

    async def _after_death(self, reason: ProcessExit, own: bool, delay: float) -> None:
        index, self._index = self._index, None
        if index is not None and self._ledger.frames[index].state == FrameState.UPDATING:
            self._ledger.move(index, FrameState.QUEUED)
            if not reason.lost:  # a machine that is lost is no fault of the frame
                death = WorkerDied(index=index, reason=str(reason), own=own)
                await self._log.write(death)
                self._ledger.apply(death)
                # The worker may have died after its commit and before its message: then the next worker reports it.
                event = given_up(self._ledger.frames[index], death)
                if event is not None and not await self._reports.is_committed(index):
                    await self._record_failure(event)
        self._publisher.changed()
        self.worker.start_in(delay)

    def stop(self) -> None:
        """Starts no worker, gives no frame and tries no mending any more."""
        self._stopped = True
        self.worker.close()
        self._repair_queue.stop()
        if self._repair_timer is not None:
            self._repair_timer.cancel()
