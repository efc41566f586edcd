"""A scene: its state, the way of its frames through the worker, and what happens when that dies. On the event loop."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Coroutine, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

from client.wire import FrameReportModel, FrameState, ProgressModel, SceneState, SceneStatus
from scas4d_core.cameras import Camera
from scas4d_core.errors import told
from server.health import metrics
from server.ingest.acknowledge import Ingest
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
from server.repair.damage import DamageKind, DamageLog
from server.repair.mending import Mending
from server.repair.scrub import Scrub, Scrubbed
from server.scene import reports
from server.scene.background import Background
from server.scene.lookup import camera_of, committed_frame_of, report_of
from server.scene.replays import Replays
from server.scene.retention import Held, deletable
from server.scene.status import state_of, status_of
from server.scene.supervision import Supervision, given_up
from server.scene.work_clock import WorkClock
from server.settings import ServerSettings
from server.storage.definition import Definition
from server.storage.disk import no_room
from server.storage.events import Created, Died, Fact, FramesDeleted, SetAside, StatesDeleted
from server.storage.frame_store import remove
from server.storage.frame_table import FrameTable
from server.storage.journal import Journal
from server.storage.recovery import Recovered
from server.storage.snapshot import facts_of
from server.stream.hub import Event, FrameFinished, Hub, SceneChanged

log = logging.getLogger("scas4d.server")

AGAIN_S = 1.0
"""A fact that the disk has no room for is written again after so long."""


class Scene:
    """One rig, one reconstruction.

    Frames are numbered from 0 without gaps; a frame is acknowledged, waits in a bounded queue, and ends committed, set
    aside, missing or skipped. What the scene knows of them is `ledger`; every change is in the journal first.

    Args:
        found: what its folder tells, of a new scene too.
        damage: what was found damaged before.
    """

    def __init__(
        self,
        definition: Definition,
        folder: Path,
        found: Recovered,
        server: ServerSettings,
        placement: Placement,
        hub: Hub,
    ) -> None:
        self.id, self.request, self.created = definition.id, definition.request, definition.created
        self.rig = definition.request.rig.rig()
        self.server = server
        self.rules = definition.request.ingest
        least = self.rules.minimum_cameras
        self.minimum_cameras = -(-len(self.rig) // 2) if least is None else min(least, len(self.rig))
        self.queue_limit = self.rules.queue_frames or server.queue_frames
        self.spec = SceneSpec(folder, self.rig, definition.settings, self.minimum_cameras, self.rules.keep_states)
        self.ledger = found.ledger
        self.held = Held(found.sizes)
        self.damage = DamageLog(found.damage)
        self._definition = definition
        self.journal = Journal(self.spec.journal, found.good, self._all_facts, self._journal_renewed)
        self.supervision = Supervision()
        self.progress: ProgressModel | None = None
        self.points_sha256: str | None = None
        self.gaussians: int | None = None
        self.clock = WorkClock()
        self.door = asyncio.Lock()
        self.trouble = self._last_trouble()
        """Why the scene is degraded: the last frame's, or that of the worker or the disk."""
        self._at_work: int | None = None
        self._ready = False
        self._holding = 0
        self._stopping = False
        self._again: asyncio.TimerHandle | None = None
        self._background = Background(self._failed)
        self._placement = placement
        self._hub = hub
        self._files = reports.ReportFiles(self.spec.states)
        self.ingest = Ingest(self)
        self.readers = Readers(self.spec, placement, lambda files: self.mending.noticed(files))
        self.replays = Replays(self, placement)
        self.mending = Mending(self.ledger, self.damage, self, found.remake)
        self._worker: Process
        self._start_worker()
        if found.facts:
            self.background(self._write(*found.facts))
        scrubbed = Scrubbed(
            definition, self.spec, self.ledger, self.journal, self.damage, self.mending.noticed, lambda: self.at_work
        )
        self.background(Scrub(scrubbed, server.scrub_mb_per_second, server.scrub_pause_seconds).run())

    def _tell(self, event: Event) -> None:
        """Tells who listens to the scene (`server.stream.hub`); called at every change of its status or of a frame."""
        if isinstance(event, FrameFinished):
            metrics.finished(event.report)
        self._hub.publish(self.id, event)

    @property
    def frames(self) -> FrameTable:
        """All frames that are closed, by index."""
        return self.ledger.frames

    @property
    def committed(self) -> Sequence[int]:
        """Frames whose state can be read, rising."""
        return self.ledger.committed

    @property
    def next_frame(self) -> int:
        """The index that is closed next."""
        return self.ledger.next_frame

    @property
    def queued(self) -> int:
        """Frames acknowledged and not finished."""
        return self.ledger.unfinished

    @property
    def error(self) -> str | None:
        """Why the scene is failed or degraded."""
        return self.ledger.fatal or self.trouble or self.mending.trouble

    @property
    def at_work(self) -> bool:
        """Whether the worker has a frame."""
        return self._at_work is not None and self._ready

    @property
    def state(self) -> SceneState:
        """Where the scene is; see `SceneStatus`."""
        return state_of(self)

    def status(self) -> SceneStatus:
        """The scene as it is now."""
        return status_of(self)

    def camera(self, name: str) -> Camera:
        """A camera of the rig by name."""
        return camera_of(self, name)

    def committed_frame(self, index: int | None, field: str = "frame") -> int:
        """The index, or the last one for None, checked to be committed."""
        return committed_frame_of(self, index, field)

    async def report(self, index: int) -> FrameReportModel | None:
        """What became of a frame, its numbers read from disk where they are not in memory; None: it is not known."""
        return await report_of(self, self._files, index)

    # The way of a frame.

    def finished(self, report: FrameReportModel) -> None:
        """A frame ended otherwise than by the worker."""
        self._tell(FrameFinished(report))

    def work(self) -> None:
        """Gives the worker its next frame, if it can take one and one waits; called whenever that may have changed."""
        self._tell(SceneChanged())
        ledger = self.ledger
        if not self._ready or self._at_work is not None or self._holding or self.mending.at_work is not None:
            return
        waiting = [] if ledger.paused or ledger.fatal is not None else ledger.waiting()
        if not waiting:
            self.mending.begin()
            return
        index = waiting[0]
        entry = ledger.frames[index]
        receipt = entry.receipt
        assert receipt is not None
        ledger.move(index, FrameState.UPDATING)
        self._at_work = index
        self.clock.begin(first=not ledger.committed)
        self._worker.send(FrameReady(index, receipt.time, entry.files, receipt.identity, ledger.budget_of(index)))
        self._tell(SceneChanged())

    def _from_worker(self, message: Any) -> None:
        match message:
            case Ready():
                self.background(self._taken_up(message))
            case Progressed():
                self.progress = ProgressModel(
                    stage=message.stage, done=message.done, total=message.total, detail=message.detail
                )
                self.clock.progress(message.stage, message.done, message.total)
                self._tell(SceneChanged())
            case FrameCommitted():
                self.background(self._commit(message))
            case FrameFailed():
                fact = SetAside(
                    index=message.index, reason=message.reason, dropped=message.dropped, fatal=message.fatal
                )
                self.background(self._set_aside(fact))
            case Mended():
                self.mending.mended(message)
            case Stalled():
                self.trouble = f"frame {message.index} waits for room on the disk: {message.reason}"
                self.clock.stall(message.seconds)
                self._tell(SceneChanged())
            case Broken():
                self.ledger.fatal = f"what is committed cannot be gone on from: {message.reason}"
                log.error("scene %s: %s", self.id, self.ledger.fatal)
                self._tell(SceneChanged())

    async def _taken_up(self, ready: Ready) -> None:
        """The worker has taken up what is committed: what it found decides which frames are still to be done."""
        newest = self.committed[-1] if self.committed else -1
        again = self.mending.frames | {index for index in ready.damaged if index < max(ready.indices, default=-1)}
        facts = self.ledger.reconcile(ready.indices, ready.damaged, again)
        for fault in ready.faults:
            log.warning("scene %s: %s", self.id, fault)
            self.damage.say(DamageKind.STATE, fault)
        if facts:
            await self._write(*facts)
        if ready.indices and ready.report:
            self._fill(ready.indices[-1], ready.report)
            self.readers.refresh()
            if ready.indices[-1] > newest:  # committed, and its worker was gone before it could say so
                self._tell(FrameFinished(self.frames[ready.indices[-1]].report))
        self.trouble = self._last_trouble()
        self._ready = True
        self.mending.taken_up(ready.damaged)
        self.work()

    def _last_trouble(self) -> str | None:
        """What was wrong with the newest frame that was tried."""
        last = self.ledger.last_tried()
        return None if last is None else reports.trouble(self.frames[last].report)

    async def _commit(self, message: FrameCommitted) -> None:
        self.supervision.committed()
        self.clock.end(committed=True)
        self._at_work, self.progress = None, None
        self.ledger.move(message.index, FrameState.COMMITTED)
        self._fill(message.index, message.report)
        report = self.frames[message.index].report
        self.trouble = reports.trouble(report)
        self.readers.refresh((message.index, *message.deleted))
        self._tell(FrameFinished(report))
        self.work()
        if message.deleted:
            self.mending.retired(message.deleted)
            deleted = StatesDeleted(frames=message.deleted)
            self.ledger.apply(deleted)
            self._tell(SceneChanged())
            await self._write(deleted)
        await self.retain()
        await self.ingest.close_what_can_be()

    async def _set_aside(self, fact: SetAside) -> None:
        await self._write(fact)
        self.ledger.apply(fact)
        self.clock.end(committed=False)
        self._at_work, self.progress = None, None
        self.trouble = reports.trouble(self.frames[fact.index].report)
        if fact.fatal:
            async with self.door:  # from here on none is taken; the one that is just being taken waits like the others
                pass
            await self._fail_those_that_wait()
        log.warning("scene %s: %s", self.id, self.trouble)
        self._tell(FrameFinished(self.frames[fact.index].report))
        self.work()
        await self.ingest.close_what_can_be()

    async def _fail_those_that_wait(self) -> None:
        facts = self.ledger.hopeless()
        if facts:
            await self._write(*facts)
        for fact in facts:
            self.ledger.apply(fact)
            self._tell(FrameFinished(self.frames[fact.index].report))

    def _fill(self, index: int, committed: dict[str, Any]) -> None:
        self.frames.set_numbers(index, committed)
        report = self.frames[index].report
        self.gaussians = report.gaussians

    async def retain(self) -> None:
        """Deletes pictures from the frame log by the scene's rule."""
        needed = self.mending.frames
        gone = [i for i in deletable(self.ledger, self.held, self.rules.keep_frames) if i not in needed]
        if not gone:
            return
        names = [name for index in gone for name in self.frames[index].files]
        self.held.discard(names)
        fact = FramesDeleted(frames=tuple(gone))
        self.ledger.apply(fact)
        self._tell(SceneChanged())
        await asyncio.to_thread(remove, self.spec.frames, names)
        await self._write(fact)

    async def _write(self, *facts: Fact) -> None:
        """Appends facts that have happened and cannot be refused: again and again until there is room."""
        while True:
            try:
                await self.journal.append(*facts)
                return
            except OSError as error:
                if not no_room(error):
                    raise
                self.trouble = f"the journal waits for room on the disk: {told(error)}"
                self._tell(SceneChanged())
                await asyncio.sleep(AGAIN_S)

    # What mending needs of it (`server.repair.mending.Hooks`), and the journal.

    def to_worker(self, message: Any) -> bool:
        """Posts a message; False where there is no worker that takes any."""
        if self._ready:
            self._worker.send(message)
        return self._ready

    def states_changed(self, frames: tuple[int, ...]) -> None:
        """Files of states were written or lost."""
        if frames:
            self.readers.refresh(frames)
        self.work()

    def write_fact(self, fact: Fact) -> None:
        """Journals a fact that was applied, in the background."""
        self.background(self._write(fact))

    def _all_facts(self) -> Iterator[Fact]:
        """What the journal has to say; see `Journal`."""
        return chain((Created(definition=self._definition.as_json()),), facts_of(self.ledger.copy()))

    def _journal_renewed(self, fault: str) -> None:
        self.damage.say(DamageKind.JOURNAL, f"{fault}; it was written anew from what the service knows")
        self._tell(SceneChanged())

    # The worker's life.

    def _start_worker(self) -> None:
        self.supervision.started()
        self._worker = self._placement.start(worker.main, self.spec, self._from_worker, self._worker_ended)

    def _worker_ended(self, reason: Ended) -> None:
        self._ready, self.progress = False, None
        self.clock.end(committed=False)
        if self._stopping or self.ledger.fatal is not None:
            return
        metrics.RESTARTS.labels("worker").inc()
        own, delay = self.supervision.died(reason.exit_code)
        self.trouble = f"the worker is gone: {reason}; it is started again in {delay:g} s"
        log.error("scene %s: %s", self.id, self.trouble)
        self.background(self._after_death(str(reason), own, delay))

    async def _after_death(self, reason: str, own: bool, delay: float) -> None:
        index, self._at_work = self._at_work, None
        if index is not None and self.frames[index].state == FrameState.UPDATING:
            self.ledger.move(index, FrameState.QUEUED)
            death = Died(index=index, reason=reason, own=own)
            await self._write(death)
            self.ledger.apply(death)
            # It may have died between its commit and saying so: the next worker tells, and only then is it given up.
            fact = given_up(self.frames[index], death)
            if fact is not None and not await asyncio.to_thread(self._is_committed, index):
                await self._set_aside(fact)
        self._tell(SceneChanged())
        if not self._stopping:
            self._again = asyncio.get_running_loop().call_later(delay, self._start_worker)

    def _is_committed(self, index: int) -> bool:
        return bool(self._files.read(index))

    @contextmanager
    def no_frame_begins(self) -> Iterator[None]:
        """The worker is given no frame inside; the one at work goes on."""
        self._holding += 1
        try:
            yield
        finally:
            self._holding -= 1
            self.work()

    async def pause(self, paused: bool) -> None:
        """Reconstructs nothing more after the frame at work; or goes on."""
        await self.ingest.pause(paused)
        self.work()

    def background(self, coroutine: Coroutine[Any, Any, None]) -> None:
        """In the background, in the order of the calls where they do not wait; the scene's end cancels it."""
        self._background.run(coroutine)

    def _failed(self, error: BaseException) -> None:
        self.ledger.fatal = f"the service failed: {type(error).__name__}: {told(error)}"
        log.error("scene %s", self.id, exc_info=error)
        self._tell(SceneChanged())

    async def stop(self) -> None:
        """Ends both processes; what is on disk stays."""
        self._stopping = True
        if self._again is not None:
            self._again.cancel()
        self.ingest.stop()
        self.mending.stop()
        self._background.cancel()
        await asyncio.gather(self._worker.stop(), self.readers.stop(), self.replays.stop())
        await self.journal.close()
