"""Ledger of the frames of a scene, built from its journal events, and the log that journals every change.

`Ledger.apply` is called while a scene is running, and also when a scene is recovered from its
folder.
"""

from __future__ import annotations

import asyncio
import copy
import json
from bisect import bisect_left
from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import islice

import numpy as np
from blake3 import blake3

from client.wire import Budget, FrameState, Retention
from scas4d_core.errors import message_of
from scas4d_core.frame_times import FrameTime, time_after
from scas4d_core.storage.history import NEWEST_KEPT
from server.storage.disk import full_disk, no_room
from server.storage.events import (
    BudgetChanged,
    CameraAccepted,
    ClosedBy,
    FrameAccepted,
    FrameFailed,
    FrameMissing,
    FramesSkipped,
    Hashes,
    JournalEvent,
    OpenFrame,
    PauseChanged,
    PicturesDeleted,
    ReconstructionBegun,
    SceneEdited,
    StateFound,
    StatesDeleted,
    WorkerDied,
)
from server.storage.frame_store import FrameLogIndex, remove
from server.storage.frame_table import CODES, DELETED, FEW_STATES, RECEIPT, FrameTable
from server.storage.journal import Journal

MOST_DELETED = 1000
"""Maximum number of frames whose images are deleted at once, so that other work is not delayed."""
RETRY_S = 1.0
"""Delay in seconds before writing an event is retried if the disk is full."""
NO_FIRST_FRAME = "the scene failed at an earlier frame"


def frame_identity(hashes: Hashes, time: float) -> str:
    """Returns the identity of a frame, which depends on its files and its time in seconds.

    The identity is the BLAKE3 digest of the sorted (camera, kind, file digest) tuples and the time.
    """
    parts = sorted((camera, str(kind), value) for camera, files in hashes.items() for kind, value in files.items())
    return blake3(json.dumps([parts, time]).encode()).hexdigest()


class Ledger:
    """In-memory state of a scene's frames, without disk, process or clock access.

    Attributes:
        frames: table of all frames with an index below `next_frame`.
        open: frames whose cameras upload separately and that are not closed yet, keyed by index.
        paused: whether the scene is paused.
        fatal: reason why the scene cannot continue, or None.
        failed_at: index of the frame that made the scene fail, or None.
        states_deleted: number of committed states that no longer exist.
        budgets: pairs of a frame index and the budget that applies from this frame on, in ascending
            order.
        edited: accumulated changes to name, archive flag and retention since creation.
        begun: event that started the current reconstruction, or None for the original one.
    """

    def __init__(self, scene: str) -> None:
        self.scene = scene
        self.frames = FrameTable(scene)
        self.open: dict[int, OpenFrame] = {}
        self.paused = False
        self.fatal: str | None = None
        self.failed_at: int | None = None
        self.states_deleted = 0
        self.budgets: list[tuple[int, Budget]] = [(0, Budget())]
        self.edited = SceneEdited()
        self.begun: ReconstructionBegun | None = None

    @property
    def reconstruction(self) -> int:
        """Number of the current reconstruction."""
        return 0 if self.begun is None else self.begun.number

    @property
    def committed(self) -> Sequence[int]:
        """Indices of frames with a readable committed state, in ascending order."""
        return self.frames.committed

    @property
    def counts(self) -> Mapping[FrameState, int]:
        """Number of frames in each state."""
        return self.frames.counts

    @property
    def next_frame(self) -> int:
        """Index of the next frame to be accepted."""
        return len(self.frames)

    @property
    def unfinished(self) -> int:
        """Number of acknowledged frames that are not finished."""
        return self.counts[FrameState.QUEUED] + self.counts[FrameState.UPDATING]

    @property
    def updating(self) -> bool:
        """Whether the worker is processing a frame."""
        return self.counts[FrameState.UPDATING] > 0

    def apply(self, event: JournalEvent) -> None:
        """Applies one event. Earlier events may be missing.

        Events other than `WorkerDied` may be applied twice.
        """
        match event:
            case FrameAccepted():
                parts = self.open.pop(event.index, None)
                self._grow_to(event.index)
                time = FrameTime(event.index, event.time, event.time if event.sent is None else event.sent)
                self.frames.enqueue(time, event.identity, event.files, parts)
            case CameraAccepted() if event.index >= self.next_frame:
                self.open.setdefault(event.index, OpenFrame(event.index)).add(event)
            case FrameMissing():
                self._grow_to(event.index)
                self.frames.rare_properties(event.index).error = event.reason
                self.set_state(event.index, FrameState.MISSING)
            case FramesSkipped():
                for index in event.frames:
                    self._grow_to(index)
                    self.frames.skip(index, event.by)
            case FrameFailed():
                self._grow_to(event.index)
                note = self.frames.rare_properties(event.index)
                note.error, note.dropped = event.reason, dict(event.dropped)
                if event.fatal:
                    self.fatal, self.failed_at = event.reason, event.index
                self.set_state(event.index, FrameState.FAILED)
            case WorkerDied():
                self._grow_to(event.index)
                note = self.frames.rare_properties(event.index)
                note.own_deaths += event.own
                note.other_deaths += not event.own
            case PicturesDeleted():
                for index in event.frames:
                    self._grow_to(index)
                    self.frames.set_files(index, ())
            case StatesDeleted():
                self._grow_to(max(event.frames, default=-1))
                self.states_deleted += self.frames.delete_states(event.frames)
                if event.reason is not None and len(event.frames) < FEW_STATES:
                    for index in event.frames:
                        self.frames.rare_properties(index).error = event.reason
            case StateFound():
                self._grow_to(event.index)
                self.frames.add_committed(event.index, event.time)
            case PauseChanged():
                self.paused = event.paused
            case SceneEdited():
                self.edited = event.merged_with(self.edited)
            case ReconstructionBegun() if event.number > self.reconstruction:
                self.begun, self.states_deleted = event, 0
                self.fatal = self.failed_at = None
                self.frames.restart(event.index)
            case BudgetChanged():
                self.budgets = [one for one in self.budgets if one[0] < event.index] or [(0, Budget())]
                self.budgets.append((event.index, event.budget))
            case _:  # scene creation, an image of a closed frame, or a known reconstruction
                pass

    def budget_of(self, index: int) -> Budget:
        """Returns the budget that applies to a frame."""
        return next(budget for first, budget in reversed(self.budgets) if first <= index)

    def next_to_begin(self) -> int:
        """Returns the first frame whose update has not started; a new budget applies from this frame on."""
        return next(iter(self.waiting()), self.next_frame)

    def set_state(self, index: int, state: FrameState) -> None:
        """Sets the state of a frame."""
        self.frames.set_state(index, state)

    def reconcile(
        self, indices: Sequence[int], damaged: Mapping[int, str], recompute: Collection[int] = ()
    ) -> list[JournalEvent]:
        """Reconciles the frames with the committed states on disk, and returns the events that the journal lacks.

        Args:
            indices: frame indices of the readable states, in ascending order.
            damaged: maps the frame index of each unreadable state to the reason.
            recompute: frame indices of damaged or missing states that will be recomputed; they produce no events.

        Returns:
            Events that have been applied and must be appended to the journal. They record missing states, and frames
            that need an update but whose images have been deleted.
        """
        last = indices[-1] if indices else -1
        events: list[JournalEvent] = []
        if last >= self.next_frame:  # the journal is damaged
            self._grow_to(last)
        frames, count = self.frames, self.next_frame
        readable = np.zeros(count, bool)
        readable[[index for index in indices if index < count]] = True
        codes = frames.states()
        for index in np.flatnonzero(codes[last + 1 :] == CODES[FrameState.COMMITTED]) + last + 1:
            frames.set_state(int(index), FrameState.QUEUED)
            self.states_deleted -= frames.restore_state(int(index))
            if not frames[int(index)].files:
                events.append(FrameFailed(index=int(index), reason="its state is damaged, and its images are deleted"))
        frames.commit_up_to(last)
        lost = readable & (codes == CODES[FrameState.FAILED]) & ~frames.flagged(RECEIPT)
        for index in np.flatnonzero(lost):  # the event is lost, but the state exists
            frames.rare_properties(int(index)).error = None
            frames.set_state(int(index), FrameState.COMMITTED)
        unreadable = (frames.states() == CODES[FrameState.COMMITTED]) & ~frames.flagged(DELETED) & ~readable
        gone = tuple(index for index in np.flatnonzero(unreadable).tolist() if index not in recompute)
        for again in recompute:
            if again < count and unreadable[again]:
                frames.set_unreadable(again, True)
        if gone:
            reasons = "; ".join(damaged[index] for index in gone if index in damaged)
            events.append(StatesDeleted(frames=gone, reason=reasons or "found missing"))
        for event in events:
            self.apply(event)
        return events

    def copy(self) -> Ledger:
        """Returns a copy without commit records, for reading in another thread."""
        new = Ledger(self.scene)
        new.frames, new.open = self.frames.copy(), copy.deepcopy(self.open)
        new.paused, new.states_deleted = self.paused, self.states_deleted
        new.fatal, new.failed_at = self.fatal, self.failed_at
        new.budgets, new.begun, new.edited = list(self.budgets), self.begun, self.edited
        return new

    def waiting(self) -> list[int]:
        """Returns the queued frames that the worker has not started, in ascending order."""
        indices: list[int] = []  # scan backwards, because queued frames are always the newest
        for index in range(self.next_frame - 1, -1, -1):
            if len(indices) == self.counts[FrameState.QUEUED]:
                break
            if self.frames[index].state == FrameState.QUEUED:
                indices.append(index)
        return indices[::-1]

    def failures_of_waiting_frames(self) -> list[FrameFailed]:
        """Returns events that fail all waiting frames after a fatal failure; the events are not applied."""
        if self.fatal is None:
            return []
        return [FrameFailed(index=index, reason=f"{NO_FIRST_FRAME}: {self.fatal}") for index in self.waiting()]

    def last_tried(self) -> int | None:
        """Returns the newest frame that was committed or has failed, or None."""
        states = self.frames.states()
        states[: self.frames.first] = CODES[FrameState.SKIPPED]  # not attempted: the reconstruction starts after them
        tried = np.flatnonzero((states == CODES[FrameState.COMMITTED]) | (states == CODES[FrameState.FAILED]))
        return int(tried[-1]) if len(tried) else None

    def times_before(self, index: int, count: int = 1) -> list[FrameTime]:
        """Returns the times of the last `count` closed frames before a frame, in ascending order of their indices."""
        newest: list[FrameTime] = []
        for before in range(min(index, self.next_frame) - 1, -1, -1):
            if len(newest) == count:
                break
            if (times := self.frames[before].times) is not None:
                newest.append(times)
        return newest[::-1]

    def accepted_event(
        self,
        index: int,
        sent: float,
        hashes: Hashes,
        files: tuple[str, ...],
        fps: float,
        closed_by: ClosedBy,
        *,
        time: float | None = None,
    ) -> FrameAccepted:
        """Returns the event that acknowledges a frame.

        Args:
            index: frame index; earlier frames are closed.
            sent: time that the client sent, in seconds.
            hashes: digests of the frame's files.
            files: names of the frame's records in the frame log.
            fps: frame rate of the scene.
            closed_by: reason why the frame is closed.
            time: time of the frame in seconds; None to compute it from the sent time.
        """
        if time is None:
            previous = self.times_before(index)
            time = time_after(previous[0] if previous else None, index, sent, fps)
        return FrameAccepted(
            index=index,
            time=time,
            sent=None if sent == time else sent,
            identity=frame_identity(hashes, time),
            files=files,
            closed_by=closed_by,
        )

    def _grow_to(self, index: int) -> None:
        """Grows the table so that it contains a frame. New frames have the state FAILED.

        Open frames up to this frame are removed, because they are closed now.
        """
        if index >= self.next_frame:
            for new in [new for new in self.open if new <= index]:
                del self.open[new]
            self.frames.grow(index + 1)


class SceneLog:
    """Journal, ledger and frame log of one scene. A change is journalled before it is applied to the ledger.

    Args:
        ledger: the scene's ledger.
        journal: the scene's journal.
        pictures: index of the scene's frame log.
        waits: function called with a message each time a journal write waits for disk space.

    Attributes:
        lock: lock held while the next frame is being accepted.
    """

    def __init__(self, ledger: Ledger, journal: Journal, pictures: FrameLogIndex, waits: Callable[[str], None]) -> None:
        self.ledger = ledger
        self.journal = journal
        self.pictures = pictures
        self.lock = asyncio.Lock()
        self._waits = waits

    async def append(self, *events: JournalEvent) -> None:
        """Appends events to the journal and then applies them.

        Raises:
            Problem: 507 if the disk is full; nothing has changed.
        """
        try:
            await self.journal.append(*events)
        except OSError as error:
            if not no_room(error):
                raise
            raise full_disk(error) from None
        for event in events:
            self.ledger.apply(event)

    async def write(self, *events: JournalEvent) -> None:
        """Appends events that must not be lost, and retries until there is disk space.

        The events are only written to the journal. The caller applies them to the ledger.
        """
        while True:
            try:
                await self.journal.append(*events)
                return
            except OSError as error:
                if not no_room(error):
                    raise
                self._waits(f"the journal is waiting for disk space: {message_of(error)}")
                await asyncio.sleep(RETRY_S)

    async def delete_pictures(self, names: Collection[str]) -> None:
        """Deletes records from the frame log and its index."""
        self.pictures.discard(names)
        await asyncio.to_thread(remove, self.pictures.folder, names)

    def deletable(self, rule: Retention, now: float) -> list[int]:
        """Returns frames whose images can be deleted under the retention rule, oldest first, at most `MOST_DELETED`.

        The images of unfinished frames are kept. An interrupted scene may roll back to one of its
        `NEWEST_KEPT` newest commits. The images of all frames after the oldest of these commits are
        therefore kept too.

        Args:
            rule: retention rule for images.
            now: current time in seconds since the epoch.
        """
        ledger, pictures = self.ledger, self.pictures
        if len(ledger.committed) < NEWEST_KEPT or rule == Retention():
            return []
        last_safe = ledger.committed[-NEWEST_KEPT]
        count = bisect_left(pictures.frames, len(ledger.frames))  # later records belong to open frames
        gone: list[int] = []
        total = pictures.bytes
        for place, index in enumerate(islice(pictures.frames, count)):
            entry = ledger.frames[index]
            if index > last_safe or len(gone) == MOST_DELETED:
                break
            surplus = rule.last is not None and count - place > rule.last
            excess = rule.bytes is not None and total > rule.bytes
            if not (surplus or excess or (rule.seconds and pictures.received(entry.files) < now - rule.seconds)):
                break
            if not entry.finished:
                continue
            total -= pictures.size(entry.files)
            gone.append(index)
        return gone
