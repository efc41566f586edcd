"""What is known of each frame of a scene, in columns: a day at 30 a second is 2.6 million frames. No disk, no clock.

46 bytes a frame for ever; what only some frames have (a reason, records in the frame log, deaths of the worker) lies in
dictionaries beside, and the numbers of a commit stay with the newest few: those of older ones are read from disk.
"""

from __future__ import annotations

import copy
from array import array
from bisect import bisect_left
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from client.wire import FINISHED, FrameReceipt, FrameReportModel, FrameState
from server.scene import reports

if TYPE_CHECKING:
    from server.storage.ledger import OpenFrame

LOST = "the journal's record of this frame is damaged, and so it is not known what was sent"

STATES = tuple(FrameState)
CODES = {state: code for code, state in enumerate(STATES)}
TIME, RECEIPT, DELETED, UNREADABLE = 1, 2, 4, 8
"""Flags: it has a time; it was acknowledged, and has an identity; its committed state is gone; it is damaged, and is
being made again."""
IDENTITY = 32
"""Bytes."""
FEW = 32
"""States so few are taken out of the list one by one."""


@dataclass(slots=True)
class Note:
    """What most frames do not have."""

    error: str | None = None
    dropped: dict[str, str] = field(default_factory=dict)
    own_deaths: int = 0
    other_deaths: int = 0
    parts: OpenFrame | None = None
    """What it was closed from, while its pictures are held."""


class FrameTable:
    """Frames of one scene by index, without gaps.

    Attributes:
        counts: frames in each state. committed: rising indices whose state can be read.
    """

    def __init__(self, scene: str) -> None:
        self.scene = scene
        self.counts = dict.fromkeys(FrameState, 0)
        self.committed: array[int] = array("q")
        self._states = bytearray()
        self._flags = bytearray()
        self._times = array("d")
        self._identities = bytearray()
        self._skipped_by = array("i")
        self._files: dict[int, tuple[str, ...]] = {}
        self._notes: dict[int, Note] = {}
        self._numbers: OrderedDict[int, Mapping[str, Any]] = OrderedDict()

    def __len__(self) -> int:
        return len(self._states)

    def __contains__(self, index: object) -> bool:
        return isinstance(index, int) and 0 <= index < len(self._states)

    def __getitem__(self, index: int) -> FrameEntry:
        if index not in self:
            raise KeyError(index)
        return FrameEntry(self, index)

    def get(self, index: int) -> FrameEntry | None:
        """The frame, or None where it is not closed yet."""
        return FrameEntry(self, index) if index in self else None

    def grow(self, count: int) -> None:
        """Has `count` frames; nothing is known of the new ones."""
        new = count - len(self)
        if new > 0:
            self._states.extend(bytes([CODES[FrameState.SET_ASIDE]]) * new)
            self._flags.extend(bytes(new))
            self._times.frombytes(bytes(8 * new))
            self._identities.extend(bytes(IDENTITY * new))
            self._skipped_by.frombytes(bytes(self._skipped_by.itemsize * new))
            self.counts[FrameState.SET_ASIDE] += new

    def held(self) -> Iterator[FrameEntry]:
        """Frames that have records in the frame log."""
        return (FrameEntry(self, index) for index in sorted(self._files))

    def states(self) -> NDArray[np.uint8]:
        """[N] places in `STATES`; a copy."""
        return np.frombuffer(bytes(self._states), np.uint8)

    def flagged(self, flag: int) -> NDArray[np.bool_]:
        """[N] whether frames have a flag; a copy."""
        found: NDArray[np.bool_] = (np.frombuffer(bytes(self._flags), np.uint8) & flag) != 0
        return found

    def copy(self) -> FrameTable:
        """All of it but the numbers of commits, for who goes through it elsewhere."""
        new = FrameTable(self.scene)
        for name in ("_states", "_flags", "_times", "_identities", "_skipped_by", "_files", "counts", "committed"):
            setattr(new, name, copy.copy(getattr(self, name)))
        new._notes = copy.deepcopy(self._notes)
        return new

    # Changes; `server.storage.ledger` makes them.

    def take(self, index: int, time: float, identity: str, files: tuple[str, ...], parts: OpenFrame | None) -> None:
        """The frame was acknowledged and is queued."""
        self._times[index] = time
        self._flags[index] |= TIME | RECEIPT
        self._identities[IDENTITY * index : IDENTITY * (index + 1)] = bytes.fromhex(identity)
        self._files[index] = files
        if index in self._notes:
            self._notes[index].error = None
        if parts is not None:
            self.note(index).parts = parts
        self.move(index, FrameState.QUEUED)

    def move(self, index: int, state: FrameState) -> None:
        """The frame is in another state."""
        before = STATES[self._states[index]]
        self.counts[before] -= 1
        self.counts[state] += 1
        self._states[index] = CODES[state]
        if FrameState.COMMITTED in (before, state):
            self._list(index, state == FrameState.COMMITTED and not self._flags[index] & (DELETED | UNREADABLE))

    def found(self, index: int, time: float | None) -> None:
        """Its committed state is there, and nothing else is known of it."""
        if time is not None:
            self._times[index] = time
            self._flags[index] |= TIME
        if index in self._notes:
            self._notes[index].error = None
        self.move(index, FrameState.COMMITTED)

    def set_unreadable(self, index: int, unreadable: bool) -> None:
        """Its committed state is damaged and is being made again; or that is over."""
        self._flags[index] = self._flags[index] | UNREADABLE if unreadable else self._flags[index] & ~UNREADABLE
        self.move(index, STATES[self._states[index]])

    def skip(self, index: int, by: int) -> None:
        """The frame was skipped for another one."""
        self._skipped_by[index] = by
        self.move(index, FrameState.SKIPPED)

    def delete_states(self, indices: Sequence[int]) -> int:
        """Committed states are gone; answers of how many that was not known."""
        new = 0
        for index in indices:
            new += not self._flags[index] & DELETED
            self._flags[index] |= DELETED
        if len(indices) < FEW:
            for index in indices:
                self._list(index, False)
        else:
            self._list_all()
        return new

    def restore_state(self, index: int) -> bool:
        """The state of a frame that is not committed now may be made again; answers whether it was gone."""
        gone = bool(self._flags[index] & DELETED)
        self._flags[index] &= ~(DELETED | UNREADABLE)
        if index in self._notes:
            self._notes[index].error = None
        return gone

    def commit_up_to(self, last: int) -> None:
        """All frames up to `last` that are queued or at work are committed: many at once, after a start."""
        states = np.frombuffer(self._states, np.uint8)
        for state in (FrameState.QUEUED, FrameState.UPDATING):
            found = np.flatnonzero(states[: last + 1] == CODES[state])
            states[found] = CODES[FrameState.COMMITTED]
            self.counts[state] -= len(found)
            self.counts[FrameState.COMMITTED] += len(found)
        del states  # the column cannot grow while it is looked at
        self._list_all()

    def set_files(self, index: int, files: tuple[str, ...]) -> None:
        """Its records in the frame log; with the last one goes what it was closed from."""
        if files:
            self._files[index] = files
            return
        self._files.pop(index, None)
        if (note := self._notes.get(index)) is not None:
            note.parts = None
            if note == Note():
                del self._notes[index]

    def note(self, index: int) -> Note:
        """To be written to."""
        return self._notes.setdefault(index, Note())

    def set_numbers(self, index: int, committed: Mapping[str, Any]) -> None:
        """What was committed with the frame, as `History.report` gives it."""
        self._numbers[index] = committed
        self._numbers.move_to_end(index)
        while len(self._numbers) > reports.KEPT:
            self._numbers.popitem(last=False)

    def remember(self, index: int, committed: Mapping[str, Any]) -> None:
        """The same of a frame that is not new, where there is room: the newest stay."""
        if committed and index not in self._numbers and len(self._numbers) < reports.KEPT:
            self._numbers[index] = committed
            self._numbers.move_to_end(index, last=False)

    def amend(self, index: int, committed: Mapping[str, Any]) -> None:
        """The same of a frame whose state is another one now."""
        if index in self._numbers:
            self._numbers[index] = committed
        else:
            self.remember(index, committed)

    def _list_all(self) -> None:
        readable = (self.states() == CODES[FrameState.COMMITTED]) & ~self.flagged(DELETED | UNREADABLE)
        self.committed = array("q", np.flatnonzero(readable).astype(np.int64).tobytes())

    def _list(self, index: int, readable: bool) -> None:
        place = bisect_left(self.committed, index)
        there = place < len(self.committed) and self.committed[place] == index
        if readable and not there:
            self.committed.insert(place, index)
        elif there and not readable:
            del self.committed[place]


class FrameEntry:
    """What the service knows of a frame that is closed: a look into the table, made when it is asked for."""

    __slots__ = ("_table", "index")

    def __init__(self, table: FrameTable, index: int) -> None:
        self._table = table
        self.index = index

    @property
    def state(self) -> FrameState:
        """Where it is."""
        return STATES[self._table._states[self.index]]

    @property
    def finished(self) -> bool:
        """Nothing more happens to it."""
        return self.state in FINISHED

    @property
    def deleted(self) -> bool:
        """It was committed, and its state cannot be read any more."""
        return bool(self._table._flags[self.index] & DELETED)

    @property
    def unreadable(self) -> bool:
        """It was committed, its state is damaged, and it is being made again."""
        return bool(self._table._flags[self.index] & UNREADABLE)

    @property
    def time(self) -> float | None:
        """Seconds; None where it never came."""
        return self._table._times[self.index] if self._table._flags[self.index] & TIME else None

    @property
    def identity(self) -> str | None:
        """As in its receipt."""
        if not self._table._flags[self.index] & RECEIPT:
            return None
        return self._table._identities[IDENTITY * self.index : IDENTITY * (self.index + 1)].hex()

    @property
    def receipt(self) -> FrameReceipt | None:
        """What its sender was answered; None where it never came, or where that is lost."""
        identity, time = self.identity, self.time
        if identity is None or time is None:
            return None
        return FrameReceipt(scene=self._table.scene, index=self.index, time=time, identity=identity)

    @property
    def skipped_by(self) -> int:
        """The frame that it was skipped for, where it was skipped."""
        return self._table._skipped_by[self.index]

    @property
    def files(self) -> tuple[str, ...]:
        """Its records in the frame log; none once they are deleted."""
        return self._table._files.get(self.index, ())

    @property
    def note(self) -> Note:
        """What most frames do not have; a change of it may be lost."""
        return self._table._notes.get(self.index) or Note()

    @property
    def error(self) -> str | None:
        """Why it was set aside or skipped, or is missing."""
        if (error := self.note.error) is not None:
            return error
        if self.state == FrameState.SKIPPED:
            return f"skipped: frame {self.skipped_by} came and the queue was full"
        return LOST if self.state == FrameState.SET_ASIDE else None

    @property
    def numbers(self) -> Mapping[str, Any] | None:
        """What was committed with it, where that is in memory."""
        return self._table._numbers.get(self.index)

    @property
    def measured(self) -> bool:
        """Whether the numbers of its commit are in memory."""
        return self.index in self._table._numbers

    @property
    def report(self) -> FrameReportModel:
        """All of it on the wire, with the numbers of its commit where they are in memory."""
        note = self.note
        report = FrameReportModel(
            scene=self._table.scene,
            index=self.index,
            time=self.time,
            state=self.state,
            error=self.error,
            identity=self.identity,
            attempts=note.own_deaths + note.other_deaths,
            held=bool(self.files),
            deleted=self.deleted,
            dropped_cameras=dict(note.dropped),
        )
        if self.measured:
            reports.fill(report, self._table._numbers[self.index])
        return report
