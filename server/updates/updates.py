"""Scheduling of a scene's updates: sends queued frames to the worker one at a time and records each outcome.

The next frame is sent as soon as the state of the previous one is in the worker's memory, while it is being written.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from client.wire import FrameReportModel, FrameState, IngestSettings, ProgressModel, Retention
from server import counters
from server.background import Background
from server.hub import Publisher
from server.keep_up import with_fewer_iterations, with_time_limit
from server.messages import (
    ChangeRetention,
    DecodeAhead,
    FrameCommitted,
    FrameFailedInWorker,
    FrameReady,
    FrameSolved,
    Progressed,
    Ready,
    RepairResult,
    ResumeFailed,
    StatesRetained,
    WaitingForDisk,
    WaitsForNode,
)
from server.processes.kernels import STAGE
from server.processes.placement import ProcessExit
from server.processes.readers import Readers
from server.repair.repair_queue import DamageKind, DamageLog, RepairQueue
from server.storage.events import FrameFailed, PicturesDeleted, StatesDeleted, WorkerDied
from server.storage.ledger import SceneLog
from server.updates.latency import Latencies
from server.updates.reports import FrameReports, first_frame_facts
from server.updates.trouble import Reason, Trouble, last_trouble, trouble_in_report
from server.updates.work_clock import WorkClock
from server.updates.worker_process import WorkerProcess, give_up_event

AGE_CHECK_S = 60.0
"""Seconds between checks for images that are too old while no frame is committed."""

log = logging.getLogger("scas4d.server")


class Updates:
    """Scheduler of one scene's updates. All methods run on the event loop.

    An acknowledged frame waits in the ledger until `begin` sends it to the worker as `FrameReady`. The worker responds
    with `FrameSolved`, after which it accepts the next frame, and with `FrameCommitted`; or with `FrameFailedInWorker`;
    or it dies. `_commit`, `_record_failure` and `_retry_or_fail` record the outcome. Meanwhile, the frame after it is
    announced with `DecodeAhead`.

    Args:
        scene_log: the scene's journal, ledger and frame log.
        damage: log of the scene's damaged files.
        worker: supervisor of the worker process.
        mending: the scene's repair queue.
        readers: the scene's reader processes.
        reports: the scene's frame reports.
        trouble: reason why the scene is degraded.
        publisher: publisher of the scene's events.
        background: the scene's background tasks.
        keep_frames: retention rule for images.
        skips: whether a full queue skips frames. Updates are then shortened while frames are waiting.
        first: initial value of the attribute `first`.
        now: clock that returns seconds since the epoch, for the age of images.

    Attributes:
        clock: predictor of when the current update ends.
        latencies: times of the newest frames.
        worker: supervisor of the worker process.
        progress: progress of the first frame while it is being reconstructed, or of the compilation
            of kernels before an update; otherwise None.
        first: facts about the first frame; see `first_frame_facts`.
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
        skips: bool,
        first: Mapping[str, Any],
        now: Callable[[], float] = time.time,
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
        self._skips = skips
        self._room_made: Callable[[], Awaitable[None]] | None = None
        self.clock = WorkClock()
        self.latencies = Latencies()
        self.worker = worker
        self.progress: ProgressModel | None = None
        self.first = first
        self._index: int | None = None
        """Frame that the worker is updating, or None."""
        self._writing: list[int] = []
        """Frames whose states the worker is writing, oldest first."""
        self._announced: int | None = None
        """Frame that was last announced to the worker, or None."""
        self._pauses = 0
        self._stopped = False
        self._rule: IngestSettings | None = None
        """Retention rules for states that the worker has not confirmed yet, or None."""
        self._rule_sent = False
        self._age_timer: asyncio.TimerHandle | None = None
        """Timer that calls `retain` again when images may have become too old."""
        self._now = now
        self._repair_timer: asyncio.TimerHandle | None = None
        """Timer that calls `begin` again when a repair is waiting for disk space."""
        worker.listen(self._on_message, self._on_worker_end)

    def on_queue_room(self, call: Callable[[], Awaitable[None]]) -> None:
        """Sets the coroutine function that closes open frames when an update has freed space in the queue."""
        self._room_made = call

    @property
    def at_work(self) -> bool:
        """Whether the worker is processing a frame."""
        return bool(self._unfinished) and self.worker.ready

    @property
    def has_work(self) -> bool:
        """Whether a frame, repair, retention change, worker restart or suspension of updates is in progress or pending.

        Waiting frames of a paused or failed scene do not count.
        """
        mending = self._repair_queue.at_work is not None or self._repair_queue.current_repair is not None
        waits = bool(self._pauses or self._waiting()) or self._rule is not None or self.worker.starts_again
        return bool(self._unfinished) or waits or mending

    @property
    def _unfinished(self) -> list[int]:
        """Frames that the worker is writing or updating, oldest first."""
        return self._writing if self._index is None else [*self._writing, self._index]

    def _waiting(self) -> list[int]:
        ledger = self._ledger
        return [] if ledger.paused or ledger.fatal is not None else ledger.waiting()

    def begin(self) -> None:
        """Sends the next waiting frame to the worker if idle; call this when the queue or worker state changes."""
        if self._stopped:
            return
        self._publisher.publish_status()
        ledger = self._ledger
        if self._index is not None:
            self._announce_next()
            return
        if self._pauses or self._repair_queue.at_work is not None:
            return
        waiting = self._waiting()
        if not self.worker.ready:
            if waiting or self._repair_queue.current_repair is not None or self._rule is not None:
                self.worker.start()
            return
        if self._rule is not None and not self._rule_sent:
            self._rule_sent = self.worker.send(ChangeRetention(self._rule))
        if not waiting:
            if self._repair_queue.waiting and (seconds := self._repair_queue.begin()) > 0:
                self._begin_in(seconds)
            return
        index, message = waiting[0], self._first_ready(waiting)
        ledger.set_state(index, FrameState.UPDATING)
        self._index, self._announced = index, None
        self.clock.begin(first=not ledger.committed)
        self.latencies.start(index)
        self.worker.send(message)
        self._announce_next()
        self._publisher.publish_status()

    def _first_ready(self, waiting: Sequence[int]) -> FrameReady:
        """Returns the message for the first of the waiting frames."""
        index = waiting[0]
        entry = self._ledger.frames[index]
        receipt = entry.receipt
        assert receipt is not None
        later = len(waiting) - 1
        budget = with_time_limit(self._ledger.budget_of(index), later)
        if self._skips:
            budget = with_fewer_iterations(budget, later, self.worker.spec.settings.update.iterations)
        return FrameReady(index, receipt.time, entry.files, receipt.identity, budget)

    def _announce_next(self) -> None:
        """Lets the worker decode the next frame while it is updating this one."""
        waiting = self._waiting() if self.worker.ready and not self._pauses else []
        if waiting and waiting[0] != self._announced:
            self._announced = waiting[0]
            self.worker.send(DecodeAhead(self._first_ready(waiting)))

    def _begin_in(self, seconds: float) -> None:
        if self._repair_timer is not None:
            self._repair_timer.cancel()
        self._repair_timer = asyncio.get_running_loop().call_later(seconds, self.begin)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Context manager inside which no new frame is sent to the worker; the current update continues."""
        self._pauses += 1
        try:
            yield
        finally:
            self._pauses -= 1
            self.begin()

    # Messages from the worker.

    def _on_message(self, message: Any) -> None:
        match message:
            case Ready():
                self._background.run(self._resume(message, self.worker.life))
            case Progressed():
                over = message.stage == STAGE and message.done == message.total  # the only stage that an update reports
                self.progress = None if over else ProgressModel(**vars(message))
                self.clock.progress(message.stage, message.done, message.total, message.detail.get("seconds_left"))
                self._publisher.publish_status()
            case FrameSolved():
                self.latencies.solve(message.index)
                self._start_next(message.index)
            case FrameCommitted():
                self._background.run(self._commit(message))
            case StatesRetained():
                self._rule = None
                self._background.run(self._on_states_deleted(message.deleted))
            case FrameFailedInWorker():
                event = FrameFailed(
                    index=message.index, reason=message.reason, dropped=message.dropped, fatal=message.fatal
                )
                self._background.run(self._record_failure(event))
            case RepairResult():
                frames = self._repair_queue.handle_result(message)
                if frames:
                    self._readers.refresh(frames)
                self.begin()
                if not self.first:  # the first frame's report may be readable now
                    self._background.run(self._reread_first_report())
            case WaitingForDisk():
                self.clock.stall(message.seconds)
                self._trouble.report(f"frame {message.index} is waiting for disk space: {message.reason}")
            case WaitsForNode():
                self._trouble.report(message.reason)
            case ResumeFailed():
                self._ledger.fatal = f"cannot resume from the committed states: {message.reason}"
                log.error("scene %s: %s", self._ledger.scene, self._ledger.fatal)
                self._publisher.publish_status()

    async def _resume(self, ready: Ready, life: object) -> None:
        """Reconciles the ledger with the committed states that a new worker has loaded, then continues."""
        ledger = self._ledger
        newest = ledger.committed[-1] if ledger.committed else -1
        again = self._repair_queue.waiting.keys() | {i for i in ready.damaged if i < max(ready.indices, default=-1)}
        events = ledger.reconcile(ready.indices, ready.damaged, again)
        for fault in ready.faults:
            log.warning("scene %s: %s", ledger.scene, fault)
            self._damage.add(DamageKind.STATE, fault)
        if events:
            await self._log.write(*events)
        if ready.indices and ready.report:
            self._record(ready.indices[-1], ready.report)
            self._readers.refresh()
            if ready.indices[-1] > newest:  # committed by a worker that died before it reported the commit
                self._publisher.publish_frame(ledger.frames[ready.indices[-1]].report)
        if life is None or life is not self.worker.life:  # the worker died in the meantime
            return
        self._trouble.reason = last_trouble(self._ledger)
        self.worker.ready = True
        self._repair_queue.resume(ready.damaged)
        self.begin()
        self._background.run(self.worker.remove_earlier_epochs(), endless=True)

    def _start_next(self, index: int) -> None:
        """Sends the next frame while the state of frame `index` is being written.

        After a crash, each frame is committed before the next one is sent, so that the cause of another crash is clear.
        """
        if index == self._index and not self.worker.deaths.in_a_row:
            self.clock.end(committed=True)
            self._index, self.progress = None, None
            self._writing.append(index)
            self.begin()

    async def _commit(self, message: FrameCommitted) -> None:
        self.worker.deaths.note_commit()
        if message.index == self._index:
            self.clock.end(committed=True)
            self._index, self.progress = None, None
        else:
            self._writing.remove(message.index)
        self._ledger.set_state(message.index, FrameState.COMMITTED)
        self.latencies.commit(message.index)
        self._record(message.index, message.report)
        report = self.with_latency(self._ledger.frames[message.index].report)
        self._trouble.reason = trouble_in_report(report)
        self._readers.refresh((message.index,))
        self._publisher.publish_frame(report)
        self.begin()
        await self._on_states_deleted(message.deleted)
        await self.retain()
        await self._make_room()

    def with_latency(self, report: FrameReportModel) -> FrameReportModel:
        """Returns the report of a frame with its latency, if it is known."""
        latency = self.latencies.of(report.index) if report.state == FrameState.COMMITTED else None
        return report if latency is None else report.model_copy(update={"latency": latency})

    @property
    def behind_seconds(self) -> float:
        """Seconds since the oldest unfinished frame was received."""
        return self.latencies.behind([*self._unfinished, *self._ledger.waiting()])

    async def _make_room(self) -> None:
        if self._ledger.open and self._room_made is not None:
            await self._room_made()

    async def _on_states_deleted(self, frames: tuple[int, ...]) -> None:
        if frames:
            self._repair_queue.forget_states(frames)
            self._readers.refresh(frames)
            deleted = StatesDeleted(frames=frames)
            self._ledger.apply(deleted)
            self._publisher.publish_status()
            await self._log.write(deleted)

    async def _record_failure(self, event: FrameFailed) -> None:
        await self._log.write(event)
        self._ledger.apply(event)
        self.clock.end(committed=False)
        self._index, self.progress = None, None
        self._trouble.reason = reason = trouble_in_report(self._ledger.frames[event.index].report)
        if event.fatal:
            async with self._log.lock:  # waits for a frame that is being acknowledged
                pass
            await self._fail_waiting()
        log.warning("scene %s: %s", self._ledger.scene, reason and reason.sentence)
        self._publisher.publish_frame(self._ledger.frames[event.index].report)
        self.begin()
        await self._make_room()

    async def _fail_waiting(self) -> None:
        events = self._ledger.failures_of_waiting_frames()
        if events:
            await self._log.write(*events)
        for event in events:
            self._ledger.apply(event)
            self._publisher.publish_frame(self._ledger.frames[event.index].report)

    def _record(self, index: int, record: Mapping[str, Any]) -> None:
        self._ledger.frames.set_record(index, record)
        self.first = first_frame_facts(record) or self.first

    async def _reread_first_report(self) -> None:
        """Reads the first frame's report again after it was unreadable."""
        if self._ledger.committed:
            self.first = first_frame_facts(await self._reports.record(self._ledger.committed[0])) or self.first

    async def retain(self) -> None:
        """Deletes images according to the scene's retention rule, except those needed to recompute states."""
        while gone := [i for i in self._deletable() if i not in self._repair_queue.waiting]:
            names = [name for index in gone for name in self._ledger.frames[index].files]
            event = PicturesDeleted(frames=tuple(gone))
            self._ledger.apply(event)
            self._publisher.publish_status()
            await self._log.delete_pictures(names)
            await self._log.write(event)

    def _deletable(self) -> list[int]:
        """Returns frames whose images can be deleted, and schedules the next check if the rule has a maximum age."""
        if self._age_timer is not None:
            self._age_timer.cancel()
        if self._keep_frames.seconds is not None and not self._stopped:
            loop = asyncio.get_running_loop()
            self._age_timer = loop.call_later(AGE_CHECK_S, lambda: self._background.run(self.retain()))
        return self._log.deletable(self._keep_frames, self._now())

    async def set_retention(self, rules: IngestSettings) -> None:
        """Applies new retention rules and deletes the images and states that exceed them."""
        before = self.worker.spec.retention
        if (rules.keep_states, rules.exact_states) != (before.keep_states, before.exact_states):
            self.worker.spec = replace(self.worker.spec, retention=rules)
            self._rule, self._rule_sent = rules, False
            self.begin()
        self._keep_frames = rules.keep_frames
        await self.retain()

    # Lifetime of the worker.

    def _on_worker_end(self, reason: ProcessExit) -> None:
        self.progress, self._rule_sent = None, False
        self.clock.end(committed=False)
        if self._ledger.fatal is not None:
            return
        counters.RESTARTS.labels("worker").inc()
        own, delay = self.worker.deaths.note_death(reason)
        self._trouble.reason = Reason(f"the worker exited unexpectedly ({reason}); restarting it in {delay:g} s")
        log.error("scene %s: %s", self._ledger.scene, self._trouble.reason.sentence)
        self._background.run(self._retry_or_fail(reason, own, delay))

    async def _retry_or_fail(self, reason: ProcessExit, own: bool, delay: float) -> None:
        at_work = self._unfinished
        self._index, self._announced, self._writing = None, None, []
        queued = [index for index in at_work if self._ledger.frames[index].state == FrameState.UPDATING]
        for index in queued:
            self._ledger.set_state(index, FrameState.QUEUED)
        if queued:
            index = queued[-1]
            if not reason.lost:  # the loss of a machine is not the frame's fault
                death = WorkerDied(index=index, reason=str(reason), own=own)
                await self._log.write(death)
                self._ledger.apply(death)
                # If the worker died between the commit and its message, the next worker reports the commit.
                event = give_up_event(self._ledger.frames[index], death)
                if event is not None and not await self._reports.is_committed(index):
                    await self._record_failure(event)
        self._publisher.publish_status()
        self.worker.start_in(delay)

    def stop(self) -> None:
        """Prevents any further worker start, update or repair."""
        self._stopped = True
        self.worker.close()
        self._repair_queue.stop()
        for timer in (self._repair_timer, self._age_timer):
            if timer is not None:
                timer.cancel()
