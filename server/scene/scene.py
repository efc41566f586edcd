"""A scene: wires its log, ingest, updates and readers, and answers questions about it. On the event loop."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Iterator, Sequence
from itertools import chain

from client.wire import Budget, FrameReportModel, FrameState, SceneBudget, SceneEdit, SceneState, SceneStatus
from scas4d_core.cameras import Camera
from scas4d_core.errors import message_of
from scas4d_core.first_frame.calibration.report import effective_rig
from scas4d_core.rig_checks import RigError, check_start
from server.background import Background
from server.hub import Hub, Publisher
from server.ingest.acknowledge import Ingest, IngestRules, shield_and_wait
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
from server.updates.trouble import Trouble, last_trouble
from server.updates.updates import Updates
from server.updates.worker_process import WorkerProcess

log = logging.getLogger("scas4d.server")


class Scene:
    """One rig, one reconstruction.

    Frames are numbered from 0 without gaps; a frame is acknowledged, waits in a bounded queue, and ends committed, set
    aside, missing or skipped. The ledger has all that is known of them; acknowledged changes are journalled first.

    The way of a frame: `Ingest.acknowledge` journals it, `Updates.begin` sends it to the worker, `Updates._commit`
    records that it is committed, and `Publisher.publish_frame` publishes its report.

    Args:
        found: the content of its folder, of a new scene too.
        server: settings of the service. placement: starts its processes. hub: publishes its events.

    Attributes:
        has_place: it has a place among the scenes that may have processes; else it is asleep. users: requests that are
            being answered, and connections. used: when the last of them ended, `time.monotonic`.
        log: journal, ledger and frame log. ingest: accepts whole frames. open_frames: accepts them camera by camera.
        updates: gives frames to the worker. mending: of damaged files. readers: answer queries. replays: of its last
            frames.
        points_sha256: of the initial cloud. warnings: what looks wrong with the rig, a sentence each.
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

        # Events of the scene, and its log.
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

        # Updates. Readers report damaged files to `mending`, which asks the worker to write them again.
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
            first=found.first,
        )

        # Frames that come in.
        self.ingest = Ingest(self.log, self.rules, self.updates, self._publisher, can_begin=self._check_start)
        self.open_frames = OpenFrames(self.ingest, self._background)
        self.updates.on_queue_room(self.open_frames.close_due)
        self.replays = Replays(self.spec, self.ledger, placement, self.repair_queue.report_damage, self._background)

        if content.events:
            self._background.run(self.log.write(*content.events))
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
        """Refuses to begin where distances are unknown: 422."""
        try:
            check_start(self.rig, self.points_sha256 is not None)
        except RigError as error:
            raise rig_problem(error) from None

    # Questions.

    @property
    def frames(self) -> FrameTable:
        """All closed frames, by index."""
        return self.ledger.frames

    @property
    def committed(self) -> Sequence[int]:
        """Frames whose state can be read, rising."""
        return self.ledger.committed

    @property
    def next_frame(self) -> int:
        """Index of the frame that is accepted next."""
        return self.ledger.next_frame

    @property
    def _facts(self) -> SceneFacts:
        updates = self.updates
        return SceneFacts(
            definition=self._definition,
            ledger=self.ledger,
            pictures=self.log.pictures,
            has_points=self.points_sha256 is not None,
            queue_limit=self.rules.queue_frames,
            first=updates.first,
            damage=self._damage.sentences,
            warnings=self.warnings,
            trouble=self._trouble.sentence or self.repair_queue.current_repair,
            at_work=updates.at_work,
            progress=updates.progress,
            worker_deaths=updates.worker.deaths.count,
            asleep=not self.has_place,
        )

    @property
    def error(self) -> str | None:
        """Sentence that says why the scene is failed or degraded, or None."""
        return self._facts.error

    @property
    def state(self) -> SceneState:
        """State of the scene; see `SceneStatus`."""
        return self._facts.state

    def status(self) -> SceneStatus:
        """Describes the scene as it is now."""
        return self._facts.status()

    @property
    def idle(self) -> bool:
        """True where nothing is under way that would be lost or delayed if its processes ended."""
        closing = bool(self.ledger.open) and self.rules.open_frame_seconds is not None
        busy = self.updates.has_work or self.readers.busy or self.replays.busy or self._background.busy
        return not (self.users or closing or busy or self.log.lock.locked() or self._publisher.listeners)

    def camera(self, name: str) -> Camera:
        """Returns a camera of the rig, as frame 0 refined it where that was asked for; see `camera_of`."""
        return camera_of(effective_rig(self.rig, self.updates.first), name)

    def committed_frame(self, index: int | None, field: str = "frame") -> int:
        """Returns the index, or the last one for None, once it is checked that its state can be read.

        Raises:
            Problem: 404 or 409, it cannot; 503, it is being made again.
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
                remedy="ask again, or for another frame",
                headers={"Retry-After": "2"},
            )
        other = f"ask for a committed frame, {frames.committed[0]} to {frames.committed[-1]}"
        if entry is not None and entry.deleted and entry.error is not None:
            raise Problem(404, entry.error, field=field, value=index, remedy=other)
        if entry is None or entry.state != FrameState.COMMITTED or entry.deleted:
            reason = "not here" if entry is None else entry.state.value
            if entry is not None and entry.deleted:
                reason = "deleted by the scene's retention"
            raise Problem(
                404,
                f"frame {index} is {reason}; only committed frames that are kept can be read",
                field=field,
                value=index,
                remedy=other,
            )
        return index

    async def report(self, index: int) -> FrameReportModel | None:
        """Returns the report of a frame; see `FrameReports.of`."""
        return await self._reports.of(index)

    def budget(self) -> SceneBudget:
        """Describes the budget of frames that are not begun."""
        since, asked = self.ledger.budgets[-1]
        effective = effective_budget(self.spec.settings, asked)
        return SceneBudget(scene=self.id, requested=asked, effective=effective, since=since)

    # Changes.

    async def set_budget(self, budget: Budget) -> None:
        """Sets the budget from the first frame on that is not begun; none begins while it is journalled.

        Raises:
            Problem: 409 for a failed scene, 507 when the disk is full.
        """

        async def change() -> None:
            async with self.log.lock:
                self.ingest.refuse_if_failed()
                if self.ledger.budgets[-1][1] == budget:
                    return
                with self.updates.paused():
                    await self.log.append(BudgetChanged(index=self.ledger.next_to_begin(), budget=budget))

        await shield_and_wait(change())

    async def pause(self, paused: bool) -> None:
        """Begins no frame after the one at work, or goes on; holds over a restart."""

        async def change() -> None:
            async with self.log.lock:
                if self.ledger.paused != paused:
                    await self.log.append(PauseChanged(paused=paused))

        await shield_and_wait(change())
        self.updates.begin()

    async def edit(self, edit: SceneEdit) -> None:
        """Changes name, archive or retention; they hold over a restart.

        Raises:
            Problem: 409, the scene is to be archived and frames of it wait; 507, the disk is full.
        """

        async def change() -> None:
            async with self.log.lock:
                if edit.archived:
                    self._refuse_unfinished()
                event = SceneEdited(**dict(edit))
                if event.merged_with(self.ledger.edited) != self.ledger.edited:
                    await self.log.append(event)

        await shield_and_wait(change())
        kept = self.ledger.edited.rules(self.request.ingest)
        await self.updates.set_retention(kept)

    def _refuse_unfinished(self) -> None:
        waiting = self.ledger.unfinished + len(self.ledger.open)
        if waiting and self.ledger.fatal is None:
            raise Problem(
                409,
                f"{count_noun(waiting, 'frame')} of the scene not finished",
                field="archived",
                value=True,
                remedy="wait until `queued` and `open_frames` of its status are empty (POST …/resume if it is paused)",
            )

    def start(self) -> None:
        """Starts the processes before there is anything to do: a new scene is quick with its first frame and view."""
        self.updates.worker.start()
        self.readers.start()

    async def stop(self, seconds: float = STOP_SECONDS) -> None:
        """Ends the processes of the scene; its folder stays. They have `seconds` to end by themselves."""
        self.open_frames.stop()
        self.updates.stop()
        self._background.cancel()
        await asyncio.gather(self.updates.worker.stop(seconds), self.readers.stop(seconds), self.replays.stop())
        self._background.cancel()  # what the last messages of the processes began
        await self.log.journal.close()

    # Events.

    def _all_events(self) -> Iterator[JournalEvent]:
        """Snapshot for the journal; see `Journal`."""
        return chain((SceneCreated(definition=self._definition.as_json()),), events_of(self.ledger.copy()))

    def _journal_renewed(self, fault: str) -> None:
        self._damage.add(DamageKind.JOURNAL, f"{fault}; it was written anew from what the service knows")
        self._publisher.publish_status()

    def _failed(self, error: BaseException) -> None:
        self.ledger.fatal = f"the service failed: {type(error).__name__}: {message_of(error)}"
        log.error("scene %s", self.id, exc_info=error)
        self._publisher.publish_status()
