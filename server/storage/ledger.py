"""What is known of the frames of a scene: the fold of its journal's events. No disk, no processes, no clock.

The running scene and the one that is found again after a restart go through the same `apply`.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from blake3 import blake3

from client.wire import Budget, FileKind, FrameState
from server.storage.events import (
    BudgetChanged,
    FrameAccepted,
    FrameMissing,
    FrameSetAside,
    FramesSkipped,
    Hashes,
    JournalEvent,
    PartAccepted,
    PauseChanged,
    PicturesDeleted,
    StateFound,
    StatesDeleted,
    WorkerDied,
)
from server.storage.frame_table import CODES, DELETED, FEW, LOST, RECEIPT, FrameTable

__all__ = ["LOST", "Ledger", "OpenFrame", "frame_identity"]

RETENTION = "retention"
"""Why states are deleted, where nothing is wrong with them."""
HOPELESS = "the scene has failed at a frame before"


def frame_identity(hashes: Hashes, time: float) -> str:
    """BLAKE3 over the sorted (camera, kind, BLAKE3 of the file) and the time in seconds."""
    parts = sorted((camera, str(kind), value) for camera, files in hashes.items() for kind, value in files.items())
    return blake3(json.dumps([parts, time]).encode()).hexdigest()


@dataclass
class OpenFrame:
    """A frame whose cameras send one by one."""

    index: int
    time: float | None = None
    hashes: Hashes = field(default_factory=dict)
    files: list[str] = field(default_factory=list)

    @property
    def cameras(self) -> list[str]:
        """Whose picture is here."""
        return sorted(camera for camera, kinds in self.hashes.items() if FileKind.IMAGE in kinds)

    def add(self, part: PartAccepted) -> None:
        """One more camera, or one more file of a camera."""
        self.time = part.time if self.time is None else self.time
        self.hashes.setdefault(part.camera, {}).update(part.hashes)
        if part.file not in self.files:
            self.files.append(part.file)


class Ledger:
    """Frames of one scene by index.

    Attributes:
        frames: every index below `next_frame`. open: frames that cameras send one by one. fatal: why the scene cannot
            go on, or None. budgets: the first frame that each holds for, rising.
    """

    def __init__(self, scene: str) -> None:
        self.scene = scene
        self.frames = FrameTable(scene)
        self.open: dict[int, OpenFrame] = {}
        self.paused = False
        self.fatal: str | None = None
        self.states_deleted = 0
        self.budgets: list[tuple[int, Budget]] = [(0, Budget())]

    @property
    def committed(self) -> Sequence[int]:
        """Rising indices whose state can be read."""
        return self.frames.committed

    @property
    def counts(self) -> Mapping[FrameState, int]:
        """How many frames are in each state."""
        return self.frames.counts

    @property
    def next_frame(self) -> int:
        """The index that is closed next."""
        return len(self.frames)

    @property
    def unfinished(self) -> int:
        """Frames acknowledged and not finished."""
        return self.counts[FrameState.QUEUED] + self.counts[FrameState.UPDATING]

    def apply(self, event: JournalEvent) -> None:
        """Takes one event in. Events may come twice, and those before them may be lost."""
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
            case FrameSetAside():
                self._have(event.index)
                note = self.frames.note(event.index)
                note.error, note.dropped = event.reason, dict(event.dropped)
                self.fatal = event.reason if event.fatal else self.fatal
                self.move(event.index, FrameState.SET_ASIDE)
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
                if event.reason != RETENTION and len(event.frames) < FEW:
                    for index in event.frames:
                        self.frames.note(index).error = event.reason
            case StateFound():
                self._have(event.index)
                self.frames.found(event.index, event.time)
            case PauseChanged():
                self.paused = event.paused
            case BudgetChanged():
                self.budgets = [one for one in self.budgets if one[0] < event.index] or [(0, Budget())]
                self.budgets.append((event.index, event.budget))
            case _:  # created: the scene's own; a part of a frame that is closed
                pass

    def budget_of(self, index: int) -> Budget:
        """The budget that holds for a frame."""
        return next(budget for first, budget in reversed(self.budgets) if first <= index)

    def begins_next(self) -> int:
        """The first frame that is not begun: what changes now holds from there on."""
        return next(iter(self.waiting()), self.next_frame)

    def move(self, index: int, state: FrameState) -> None:
        """A frame is in another state."""
        self.frames.move(index, state)

    def reconcile(
        self, indices: Sequence[int], damaged: Mapping[int, str], remake: Collection[int] = ()
    ) -> list[JournalEvent]:
        """Brings the frames in line with the committed states that are there, and tells what the journal lacks.

        Args:
            indices: of the states that can be read, rising. damaged: states that cannot, with the reason.
            remake: of those that are damaged or gone, states that will be made again: nothing is told of them.

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
                    FrameSetAside(index=int(index), reason="its state is damaged, and its pictures are deleted")
                )
        frames.commit_up_to(last)
        lost = readable & (codes == CODES[FrameState.SET_ASIDE]) & ~frames.flagged(RECEIPT)
        for index in np.flatnonzero(lost):  # its event is lost, its state is not
            frames.note(int(index)).error = None
            frames.move(int(index), FrameState.COMMITTED)
        unreadable = (frames.states() == CODES[FrameState.COMMITTED]) & ~frames.flagged(DELETED) & ~readable
        gone = tuple(index for index in np.flatnonzero(unreadable).tolist() if index not in remake)
        for again in remake:
            if again < count and unreadable[again]:
                frames.set_unreadable(again, True)
        if gone:
            said = "; ".join(damaged[index] for index in gone if index in damaged)
            events.append(StatesDeleted(frames=gone, reason=said or "found gone"))
        for event in events:
            self.apply(event)
        return events

    def copy(self) -> Ledger:
        """As it is now, for who goes through it elsewhere; without the numbers of commits."""
        new = Ledger(self.scene)
        new.frames, new.open = self.frames.copy(), copy.deepcopy(self.open)
        new.paused, new.fatal, new.states_deleted = self.paused, self.fatal, self.states_deleted
        new.budgets = list(self.budgets)
        return new

    def waiting(self) -> list[int]:
        """Frames that are queued and not at work, rising. Only the newest can be."""
        found: list[int] = []
        for index in range(self.next_frame - 1, -1, -1):
            if len(found) == self.counts[FrameState.QUEUED]:
                break
            if self.frames[index].state == FrameState.QUEUED:
                found.append(index)
        return found[::-1]

    def hopeless(self) -> list[FrameSetAside]:
        """Nothing will become of frames that wait behind a first one that failed: as events, not applied."""
        if self.fatal is None:
            return []
        return [FrameSetAside(index=index, reason=f"{HOPELESS}: {self.fatal}") for index in self.waiting()]

    def last_tried(self) -> int | None:
        """The newest frame that the worker has finished, well or not."""
        states = self.frames.states()
        tried = np.flatnonzero((states == CODES[FrameState.COMMITTED]) | (states == CODES[FrameState.SET_ASIDE]))
        return int(tried[-1]) if len(tried) else None

    def last_time(self) -> float | None:
        """Seconds of the newest closed frame that has a time."""
        for index in range(self.next_frame - 1, -1, -1):
            time = self.frames[index].time
            if time is not None:
                return time
        return None

    def _have(self, index: int) -> None:
        """The frame is there; indices that nothing is known of up to it are set aside as lost."""
        if index >= self.next_frame:
            for new in [new for new in self.open if new <= index]:
                del self.open[new]
            self.frames.grow(index + 1)
