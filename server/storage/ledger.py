"""Ledger of a scene's frames, folded from the events of its journal; and the log that journals what changes it.

The running scene and the one that is found again after a restart go through the same `Ledger.apply`.
"""

from __future__ import annotations

import asyncio
import copy
import json
from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np
from blake3 import blake3

from client.wire import Budget, FrameState, Retention
from scas4d_core.errors import message_of
from scas4d_core.storage.history import NEWEST_KEPT
from server.storage.disk import full_disk, no_room
from server.storage.events import (
    BudgetChanged,
    FrameAccepted,
    FrameFailed,
    FrameMissing,
    FramesSkipped,
    Hashes,
    JournalEvent,
    OpenFrame,
    PartAccepted,
    PauseChanged,
    PicturesDeleted,
    ReconstructionBegun,
    SceneEdited,
    StateFound,
    StatesDeleted,
    WorkerDied,
)
from server.storage.frame_store import FrameLogIndex, remove
from server.storage.frame_table import CODES, DELETED, FEW, RECEIPT, FrameTable
from server.storage.journal import Journal

AGAIN_S = 1.0
"""An event that the disk has no room for is written again after so long."""
HOPELESS = "the scene has failed at a frame before"


def frame_identity(hashes: Hashes, time: float) -> str:
    """BLAKE3 over the sorted (camera, kind, BLAKE3 of the file) and the time in seconds."""
    parts = sorted((camera, str(kind), value) for camera, files in hashes.items() for kind, value in files.items())
    return blake3(json.dumps([parts, time]).encode()).hexdigest()


class Ledger:
    """Frames of one scene by index. No disk, no processes, no clock.

    Attributes:
        frames: every index below `next_frame`. open: frames that cameras send one by one.
        fatal: reason why the scene cannot go on, or None. failed_at: the frame that it failed at, or None.
        budgets: the first frame that each holds for, rising.
        edited: the changes of its name, archive and retention since it was created.
        begun: the event that the present reconstruction was begun by; None: it came with the scene.
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
        """Number of the reconstruction."""
        return 0 if self.begun is None else self.begun.number

    @property
    def committed(self) -> Sequence[int]:
        """Rising indices whose state can be read."""
        return self.frames.committed

    @property
    def counts(self) -> Mapping[FrameState, int]:
        """Number of frames in each state."""
        return self.frames.counts

    @property
    def next_frame(self) -> int:
        """Index of the frame that is accepted next."""
        return len(self.frames)

    @property
    def unfinished(self) -> int:
        """Frames acknowledged and not finished."""
        return self.counts[FrameState.QUEUED] + self.counts[FrameState.UPDATING]

    @property
    def updating(self) -> bool:
        """True while the worker has a frame."""
        return self.counts[FrameState.UPDATING] > 0

    def apply(self, event: JournalEvent) -> None:
        """Applies one event. Events may come twice, and those before them may be lost."""
        match event:
            case FrameAccepted():
                parts = self.open.pop(event.index, None)
                self._have(event.index)
                self.frames.take(event.index, event.time, event.identity, event.files, parts)
            case PartAccepted() if event.index >= self.next_frame:
                self.open.setdefault(event.index, OpenFrame(event.index)).add(event)
            case FrameMissing():
                self._have(event.index)
                self.frames.note(event.index).error = event.reason
                self.move(event.index, FrameState.MISSING)
            case FramesSkipped():
                for index in event.frames:
                    self._have(index)
                    self.frames.skip(index, event.by)
            case FrameFailed():
                self._have(event.index)
                note = self.frames.note(event.index)
                note.error, note.dropped = event.reason, dict(event.dropped)
                if event.fatal:
                    self.fatal, self.failed_at = event.reason, event.index
                self.move(event.index, FrameState.FAILED)
            case WorkerDied():
                self._have(event.index)
                note = self.frames.note(event.index)
                note.own_deaths += event.own
                note.other_deaths += not event.own
            case PicturesDeleted():
                for index in event.frames:
                    self._have(index)
                    self.frames.set_files(index, ())
            case StatesDeleted():
                self._have(max(event.frames, default=-1))
                self.states_deleted += self.frames.delete_states(event.frames)
                if event.reason is not None and len(event.frames) < FEW:
                    for index in event.frames:
                        self.frames.note(index).error = event.reason
            case StateFound():
                self._have(event.index)
                self.frames.found(event.index, event.time)
            case PauseChanged():
                self.paused = event.paused
            case SceneEdited():
                self.edited = event.after(self.edited)
            case ReconstructionBegun() if event.number > self.reconstruction:
                self.begun, self.states_deleted = event, 0
                self.fatal = self.failed_at = None
                self.frames.begin_again(event.index)
            case BudgetChanged():
                self.budgets = [one for one in self.budgets if one[0] < event.index] or [(0, Budget())]
                self.budgets.append((event.index, event.budget))
            case _:  # created: the scene's own; a part of a frame that is closed; a reconstruction that is known
                pass

    def budget_of(self, index: int) -> Budget:
        """Returns the budget that holds for a frame."""
        return next(budget for first, budget in reversed(self.budgets) if first <= index)

    def begins_next(self) -> int:
        """Returns the first frame that is not begun: a new budget holds from there on."""
        return next(iter(self.waiting()), self.next_frame)

    def move(self, index: int, state: FrameState) -> None:
        """Puts a frame in another state."""
        self.frames.move(index, state)

    def reconcile(
        self, indices: Sequence[int], damaged: Mapping[int, str], recompute: Collection[int] = ()
    ) -> list[JournalEvent]:
        """Brings the frames in line with the committed states that exist, and returns what the journal lacks.

        Args:
            indices: of the states that can be read, rising. damaged: states that cannot, with the reason.
            recompute: of those that are damaged or gone, states that will be made again: no event is made of them.

        Returns:
            Events, already applied, that have to be appended: states that are gone, frames that have to be done again
            and cannot.
        """
        last = indices[-1] if indices else -1
        events: list[JournalEvent] = []
        if last >= self.next_frame:  # the journal is damaged
            self._have(last)
        frames, count = self.frames, self.next_frame
        readable = np.zeros(count, bool)
        readable[[index for index in indices if index < count]] = True
        codes = frames.states()
        for index in np.flatnonzero(codes[last + 1 :] == CODES[FrameState.COMMITTED]) + last + 1:
            frames.move(int(index), FrameState.QUEUED)
            self.states_deleted -= frames.restore_state(int(index))
            if not frames[int(index)].files:
                events.append(
                    FrameFailed(index=int(index), reason="its state is damaged, and its pictures are deleted")
                )
        frames.commit_up_to(last)
        lost = readable & (codes == CODES[FrameState.FAILED]) & ~frames.flagged(RECEIPT)
        for index in np.flatnonzero(lost):  # its event is lost, its state is not
            frames.note(int(index)).error = None
            frames.move(int(index), FrameState.COMMITTED)
        unreadable = (frames.states() == CODES[FrameState.COMMITTED]) & ~frames.flagged(DELETED) & ~readable
        gone = tuple(index for index in np.flatnonzero(unreadable).tolist() if index not in recompute)
        for again in recompute:
            if again < count and unreadable[again]:
                frames.set_unreadable(again, True)
        if gone:
            reasons = "; ".join(damaged[index] for index in gone if index in damaged)
            events.append(StatesDeleted(frames=gone, reason=reasons or "found gone"))
        for event in events:
            self.apply(event)
        return events

    def copy(self) -> Ledger:
        """Copies the ledger without records of commits, for a thread to read."""
        new = Ledger(self.scene)
        new.frames, new.open = self.frames.copy(), copy.deepcopy(self.open)
        new.paused, new.states_deleted = self.paused, self.states_deleted
        new.fatal, new.failed_at = self.fatal, self.failed_at
        new.budgets, new.begun, new.edited = list(self.budgets), self.begun, self.edited
        return new

    def waiting(self) -> list[int]:
        """Lists queued frames that the worker does not have, rising."""
        indices: list[int] = []  # scans backwards: queued frames are always the newest
        for index in range(self.next_frame - 1, -1, -1):
            if len(indices) == self.counts[FrameState.QUEUED]:
                break
            if self.frames[index].state == FrameState.QUEUED:
                indices.append(index)
        return indices[::-1]

    def hopeless(self) -> list[FrameFailed]:
        """Returns events, not applied, that fail the frames waiting behind a failed first one."""
        if self.fatal is None:
            return []
        return [FrameFailed(index=index, reason=f"{HOPELESS}: {self.fatal}") for index in self.waiting()]

    def last_tried(self) -> int | None:
        """Returns the newest frame that the worker has finished, committed or failed."""
        states = self.frames.states()
        states[: self.frames.first] = CODES[FrameState.SKIPPED]  # not tried: the reconstruction begins behind them
        tried = np.flatnonzero((states == CODES[FrameState.COMMITTED]) | (states == CODES[FrameState.FAILED]))
        return int(tried[-1]) if len(tried) else None

    def last_time(self) -> float | None:
        """Returns the seconds of the newest closed frame that has a time."""
        for index in range(self.next_frame - 1, -1, -1):
            time = self.frames[index].time
            if time is not None:
                return time
        return None

    def _have(self, index: int) -> None:
        """Grows to the frame; unknown indices up to it fail as lost."""
        if index >= self.next_frame:
            for new in [new for new in self.open if new <= index]:
                del self.open[new]
            self.frames.grow(index + 1)


class SceneLog:
    """Journal, ledger and frame log of one scene: an acknowledged change is journalled before the ledger has it.

    Args:
        ledger, journal, pictures: of the scene.
        waits: called with a sentence each time that a journal write waits for room on the disk.

    Attributes:
        lock: held while the next frame is decided.
    """

    def __init__(self, ledger: Ledger, journal: Journal, pictures: FrameLogIndex, waits: Callable[[str], None]) -> None:
        self.ledger = ledger
        self.journal = journal
        self.pictures = pictures
        self.lock = asyncio.Lock()
        self._waits = waits

    async def append(self, *events: JournalEvent) -> None:
        """Journals events and then applies them.

        Raises:
            Problem: 507, the disk is full; nothing has changed.
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
        """Journals events that cannot be refused, again and again until there is room; the caller applies them."""
        while True:
            try:
                await self.journal.append(*events)
                return
            except OSError as error:
                if not no_room(error):
                    raise
                self._waits(f"the journal waits for room on the disk: {message_of(error)}")
                await asyncio.sleep(AGAIN_S)

    async def delete_pictures(self, names: Collection[str]) -> None:
        """Deletes records of the frame log."""
        self.pictures.discard(names)
        await asyncio.to_thread(remove, self.pictures.folder, names)

    def deletable(self, rule: Retention) -> list[int]:
        """Lists the frames whose pictures the rule deletes now, rising.

        Pictures are kept of frames that are not finished, and of those newer than the commit that an interrupted scene
        may have to go back to: they would be needed again.
        """
        ledger, pictures = self.ledger, self.pictures
        if len(ledger.committed) < NEWEST_KEPT or (rule.last is None and rule.bytes is None):
            return []
        last_safe = ledger.committed[-NEWEST_KEPT]
        frames = [index for index in pictures.frames if index in ledger.frames]
        gone: list[int] = []
        total = pictures.bytes
        for place, index in enumerate(frames):
            entry = ledger.frames[index]
            surplus = rule.last is not None and len(frames) - place > rule.last
            excess = rule.bytes is not None and total > rule.bytes
            if index > last_safe or not (surplus or excess):
                break
            if not entry.finished:
                continue
            total -= pictures.size(entry.files)
            gone.append(index)
        return gone
