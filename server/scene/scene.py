"""Scene that connects its log, ingest, updates and readers, and answers queries about its state."""

from __future__ import annotations

import asyncio
import logging
import time
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from itertools import chain

from client.wire import Budget, FrameReportModel, FrameState, SceneBudget, SceneEdit, SceneState, SceneStatus
from scas4d_core.cameras import Camera
from scas4d_core.errors import message_of
from scas4d_core.first_frame.calibration.report import effective_rig
from scas4d_core.rig_checks import RigError, check_start
from server.background import Background, shielded
from server.hub import Hub, Publisher
from server.ingest.acknowledge import Ingest, IngestRules
from server.ingest.open_frames import OpenFrames
from server.messages import SceneSpec
from server.problems import Problem, count_noun, rig_problem
from server.processes.placement import STOP_SECONDS, Placement
from server.processes.readers import Readers
from server.repair.repair_queue import DamageKind, DamageLog, RepairQueue
from server.repair.scrub import Scrub
from server.scene.replays import Replays
from server.scene.status import SceneFacts, camera_of, effective_budget
from server.scene.stored_scene import StoredScene
from server.settings import ServerSettings
from server.storage.events import BudgetChanged, JournalEvent, PauseChanged, SceneCreated, SceneEdited
from server.storage.frame_store import FrameLogIndex
from server.storage.frame_table import FrameTable
from server.storage.journal import Journal
from server.storage.ledger import SceneLog
from server.storage.snapshot import events_of
from server.updates.reports import FrameReports
from server.updates.trouble import Reason, Trouble, last_trouble
from server.updates.updates import Updates
from server.updates.worker_process import WorkerProcess

log = logging.getLogger("scas4d.server")


class Scene:
    """Scene in memory, with the frames of one rig and their reconstruction. All methods run on the event loop.

    Frames are numbered from 0 without gaps. A frame is acknowledged, waits in a bounded queue, and ends up committed,
    failed, missing or skipped. The ledger contains the state of all frames. Changes are journalled before they are
    acknowledged.

    A frame passes through the following steps. `Ingest.acknowledge` journals it, `Updates.begin` sends it to the
    worker, `Updates._commit` records the commit, and `Publisher.publish_frame` publishes its report.

    Args:
        found: the scene as stored in its folder; a new scene also has a folder.
        server: service settings.
        placement: placement used to start the scene's processes.
        hub: hub through which the scene publishes its events.

    Attributes:
        has_place: whether the scene has a slot and may have processes; otherwise, it is asleep.
        users: number of active requests and connections.
        used: value of `time.monotonic` when the last request or connection ended, in seconds.
        log: journal, ledger and frame log.
        ingest: ingest of complete frames.
        open_frames: ingest of frames sent camera by camera.
        updates: scheduler of the scene's updates.
        repair_queue: queue of damaged files to repair.
        readers: reader processes that answer queries.
        replays: replays of the newest frames.
        points_sha256: SHA-256 of the uploaded initial point cloud, or None.
        warnings: warnings about the rig.
    """

    def __init__(
        self,
        found: StoredScene,
        server: ServerSettings,
        placement: Placement,
        hub: Hub,
    ) -> None:
        definition, content, folder = found.definition, found.content, found.content.folder
        request = definition.request
        self.has_place, self.users, self.used = False, 0, time.monotonic()
        self.id, self.request, self.created = definition.id, request, definition.created
        self._definition = definition
        self.rules = IngestRules.of(request, server)
        self.rig = self.rules.rig
        self.points_sha256, self.warnings = found.points_sha256, found.warnings
        self.ledger = content.ledger
        kept = self.ledger.edited.rules(request.ingest)
        self.spec = SceneSpec(
            folder,
            self.rig,
            definition.settings,
            self.rules.minimum_cameras,
            kept,
            request.frames_per_second,
            request.nodes,
        )

        # Events and log of the scene.
        self._publisher = Publisher(hub, self.id)
        self._trouble = Trouble(self._publisher, last_trouble(self.ledger))
        self._background = Background(self._failed)
        self._damage = DamageLog(content.damage)
        self.log = SceneLog(
            self.ledger,
            Journal(folder.journal, content.good, self._all_events, self._journal_renewed),
            FrameLogIndex(folder.frames, content.sizes),
            self._trouble.report,
        )

        # Updates. Readers report damaged files to the repair queue, which asks the worker to rewrite them.
        worker = WorkerProcess(self.spec, placement)
        self.repair_queue = RepairQueue(
            self.log, self._damage, self._background, to_worker=worker.send, recompute=content.recompute
        )
        self.readers = Readers(self.spec, placement, self.repair_queue.report_damage)
        self._reports = FrameReports(self.ledger, folder.states, self.repair_queue.report_damage)
        self.updates = Updates(
            self.log,
            self._damage,
            worker,
            self.repair_queue,
            self.readers,
            self._reports,
            self._trouble,
            self._publisher,
            self._background,
            keep_frames=kept.keep_frames,
            skips=self.rules.when_full == "skip",
            first=found.first,
        )

        # Incoming frames.
        self.ingest = Ingest(self.log, self.rules, self.updates, self._publisher, can_begin=self._check_start)
        self.open_frames = OpenFrames(self.ingest, self._background)
        self.updates.on_queue_room(self.open_frames.close_due)
        self.replays = Replays(self.spec, self.ledger, placement, self.repair_queue.report_damage)

        if content.events:
            self._background.run(self.log.write(*content.events))
        if kept.keep_frames.seconds is not None:
            self._background.run(self.updates.retain())
        scrub = Scrub(
            definition,
            folder,
            self.log,
            self._damage,
            self.repair_queue,
            mb_per_second=server.scrub_mb_per_second,
            pause_seconds=server.scrub_pause_seconds,
        )
        self._background.run(scrub.run(), endless=True)

    def _check_start(self) -> None:
        """Raises `Problem` (422) if the scene cannot start because depth cannot be determined."""
        try:
            check_start(self.rig, self.points_sha256 is not None)
        except RigError as error:
            raise rig_problem(error) from None

    # Queries.

    @property
    def frames(self) -> FrameTable:
        """Table of all closed frames, keyed by index."""
        return self.ledger.frames

    @property
    def committed(self) -> Sequence[int]:
        """Indices of the frames with a readable committed state, in ascending order."""
        return self.ledger.committed

    @property
    def next_frame(self) -> int:
        """Index of the next frame to be accepted."""
        return self.ledger.next_frame

    @property
    def _facts(self) -> SceneFacts:
        updates, repair = self.updates, self.repair_queue.current_repair
        return SceneFacts(
            definition=self._definition,
            ledger=self.ledger,
            pictures=self.log.pictures,
            has_points=self.points_sha256 is not None,
            queue_limit=self.rules.queue_frames,
            first=updates.first,
            damage=self._damage.sentences,
            warnings=self.warnings,
            trouble=self._trouble.reason or (Reason(repair) if repair else None),
            at_work=updates.at_work,
            behind_seconds=updates.behind_seconds,
            progress=updates.progress,
            worker_deaths=updates.worker.deaths.count,
            asleep=not self.has_place,
        )

    @property
    def error(self) -> str | None:
        """Reason why the scene has failed or is degraded, or None."""
        return self._facts.error

    @property
    def state(self) -> SceneState:
        """State of the scene; see `SceneStatus`."""
        return self._facts.state

    def status(self) -> SceneStatus:
        """Returns the current status of the scene."""
        return self._facts.status()

    @property
    def idle(self) -> bool:
        """Whether stopping the scene's processes would neither lose nor delay any work."""
        closing = bool(self.ledger.open) and self.rules.open_frame_seconds is not None
        busy = self.updates.has_work or self.readers.busy or self.replays.busy or self._background.busy
        return not (self.users or closing or busy or self.log.lock.locked() or self._publisher.listeners)

    def camera(self, name: str) -> Camera:
        """Returns a camera of the rig; see `camera_of`.

        If the calibration was refined in the first frame, the camera has the refined calibration.
        """
        return camera_of(effective_rig(self.rig, self.updates.first), name)

    def committed_range(self, first: int | None, last: int | None, field: str) -> tuple[int, ...]:
        """Returns the indices of the committed frames in a range.

        Args:
            first, last: inclusive range; None for the first and the last committed frame.
            field: name of the request's field for `first`, which a problem reports.

        Raises:
            Problem: 409 if no frame is committed; 422 if none is committed in this range.
        """
        self.committed_frame(None, field)
        start = self.committed[0] if first is None else first
        end = self.committed[-1] if last is None else last
        frames = tuple(self.committed[bisect_left(self.committed, start) : bisect_right(self.committed, end)])
        if not frames:
            raise Problem(
                422,
                f"no committed frames from {start} to {end}",
                field=field,
                value=start,
                remedy=f"use a range within {self.committed[0]} to {self.committed[-1]}"
                if first is None or last is None or first <= last
                else "exchange the first and the last frame",
            )
        return frames

    def committed_frame(self, index: int | None, field: str = "frame") -> int:
        """Checks that a frame's state is readable and returns its index.

        Args:
            index: frame index; None selects the last committed frame.
            field: name of the request's field, which a problem reports.

        Raises:
            Problem: 404 or 409 if there is no readable state; 503 if the state is being recomputed.
        """
        frames = self.ledger.frames
        if not frames.committed:
            raise Problem(
                409,
                "this scene has no committed frame yet",
                field=field,
                remedy="wait until `committed` in the scene's status is above 0",
                state=self.state,
            )
        if index is None:
            return frames.committed[-1]
        entry = frames.get(index)
        if entry is not None and entry.unreadable:
            raise Problem(
                503,
                f"the state of frame {index} was damaged on disk and is being recomputed",
                field=field,
                value=index,
                remedy="try again, or request another frame",
                headers={"Retry-After": "2"},
            )
        other = f"request a committed frame, {frames.committed[0]} to {frames.committed[-1]}"
        if entry is not None and entry.deleted and entry.error is not None:
            raise Problem(404, entry.error, field=field, value=index, remedy=other)
        if entry is None or entry.state != FrameState.COMMITTED or entry.deleted:
            reason = "unknown" if entry is None else entry.state.value
            if entry is not None and entry.deleted:
                reason = "deleted by the retention rules"
            raise Problem(
                404,
                f"frame {index} is {reason}; only committed frames that have not been deleted can be read",
                field=field,
                value=index,
                remedy=other,
            )
        return index

    async def report(self, index: int) -> FrameReportModel | None:
        """Returns the report of a frame; see `FrameReports.of`."""
        report = await self._reports.of(index)
        return None if report is None else self.updates.with_latency(report)

    def budget(self) -> SceneBudget:
        """Returns the budget for the next frame whose update starts."""
        since, asked = self.ledger.budgets[-1]
        effective = effective_budget(self.spec.settings, asked)
        return SceneBudget(scene=self.id, requested=asked, effective=effective, since=since)

    # Changes.

    @shielded
    async def set_budget(self, budget: Budget) -> None:
        """Sets the budget for all frames whose update has not started.

        No update starts while the change is being journalled.

        Raises:
            Problem: 409 if the scene has failed; 507 if the disk is full.
        """
        async with self.log.lock:
            self.ingest.refuse_if_failed()
            if self.ledger.budgets[-1][1] == budget:
                return
            with self.updates.paused():
                await self.log.append(BudgetChanged(index=self.ledger.next_to_begin(), budget=budget))

    @shielded
    async def pause(self, paused: bool) -> None:
        """Pauses updates after the current frame, or resumes them; the setting survives a service restart."""
        async with self.log.lock:
            if self.ledger.paused != paused:
                await self.log.append(PauseChanged(paused=paused))
        self.updates.begin()

    @shielded
    async def edit(self, edit: SceneEdit) -> None:
        """Changes the name, archive flag or retention rules; the changes survive a service restart.

        Raises:
            Problem: 409 if the scene cannot be archived because frames are unfinished; 507 if the disk is full.
        """
        async with self.log.lock:
            if edit.archived:
                self._refuse_unfinished()
            event = SceneEdited(**dict(edit))
            if event.merged_with(self.ledger.edited) != self.ledger.edited:
                await self.log.append(event)
        kept = self.ledger.edited.rules(self.request.ingest)
        await self.updates.set_retention(kept)

    def _refuse_unfinished(self) -> None:
        waiting = self.ledger.unfinished + len(self.ledger.open)
        if waiting and self.ledger.fatal is None:
            raise Problem(
                409,
                f"the scene has {count_noun(waiting, 'unfinished frame')}",
                field="archived",
                value=True,
                remedy="wait until `queued` and `open_frames` in its status are empty (POST …/resume if it is paused)",
            )

    def start(self) -> None:
        """Starts the processes early, so that the first frame and view of a new scene are not delayed."""
        self.updates.worker.start()
        self.readers.start()

    async def stop(self, seconds: float = STOP_SECONDS) -> None:
        """Stops the scene's processes, killing those that do not exit within `seconds`; the folder is kept."""
        self.open_frames.stop()
        self.updates.stop()
        self._background.cancel()
        await asyncio.gather(self.updates.worker.stop(seconds), self.readers.stop(seconds), self.replays.stop())
        self._background.cancel()  # tasks started by the last messages of the processes
        await self.log.journal.close()

    # Events.

    def _all_events(self) -> Iterator[JournalEvent]:
        """Returns a snapshot of all known events, which `Journal` uses to rewrite itself."""
        return chain((SceneCreated(definition=self._definition.as_json()),), events_of(self.ledger.copy()))

    def _journal_renewed(self, fault: str) -> None:
        self._damage.add(DamageKind.JOURNAL, f"{fault}; the journal was rewritten from memory")
        self._publisher.publish_status()

    def _failed(self, error: BaseException) -> None:
        self.ledger.fatal = f"internal error: {type(error).__name__}: {message_of(error)}"
        log.error("scene %s", self.id, exc_info=error)
        self._publisher.publish_status()
