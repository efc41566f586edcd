"""Frames of one scene in columns: a day at 30 frames a second is 2.6 million frames. No disk, no clock.

A frame takes 46 bytes for ever. Properties of few frames (an error, records in the frame log, deaths of the worker) lie
in dictionaries. Records of commits stay in memory for the newest frames; those of older ones are read from disk.
"""

from __future__ import annotations

import copy
from array import array
from bisect import bisect_left
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.wire import FINISHED, FrameReceipt, FrameReportModel, FrameState
from server.storage.events import Note, OpenFrame
from server.storage.report_fields import committed_fields

RECORDS_KEPT = 512
"""Records of so many newest commits stay in memory."""
LOST = "the journal's record of this frame is damaged, and so it is not known what was sent"
BARE = "the reconstruction was begun anew, and the pictures of this frame were deleted before"
STATES = tuple(FrameState)
CODES = {state: code for code, state in enumerate(STATES)}
TIME, RECEIPT, DELETED, UNREADABLE = 1, 2, 4, 8
"""Flags of a frame: it has a time; it was acknowledged and has an identity; its committed state is gone; its state is
damaged and is being made again."""
IDENTITY = 32  # bytes
FEW = 32
"""Up to so many states are removed from the list of committed ones one by one."""


class FrameTable:
    """Frames of one scene by index, without gaps.

    Attributes:
        counts: frames in each state. committed: rising indices whose state can be read.
        first: the reconstruction begins with this frame; an earlier one fails, unless it never came.
    """

    def __init__(self, scene: str) -> None:
        self.scene = scene
        self.counts = dict.fromkeys(FrameState, 0)
        self.committed: array[int] = array("q")
        self.first = 0
        self._states = bytearray()
        self._flags = bytearray()
        self._times = array("d")
        self._identities = bytearray()
        self._skipped_by = array("i")
        self._files: dict[int, tuple[str, ...]] = {}
        self._notes: dict[int, Note] = {}
        self._records: OrderedDict[int, Mapping[str, Any]] = OrderedDict()

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
        """Grows to `count` frames; nothing is known of the new ones."""
        new = count - len(self)
        if new > 0:
            self._states.extend(bytes([CODES[FrameState.FAILED]]) * new)
            self._flags.extend(bytes(new))
            self._times.frombytes(bytes(8 * new))
            self._identities.extend(bytes(IDENTITY * new))
            self._skipped_by.frombytes(bytes(self._skipped_by.itemsize * new))
            self.counts[FrameState.FAILED] += new

    def with_pictures(self) -> Iterator[FrameEntry]:
        """Yields the frames that have records in the frame log, rising."""
        return (FrameEntry(self, index) for index in sorted(self._files))

    def states(self) -> NDArray[np.uint8]:
        """[N] places in `STATES`; a copy."""
        return np.frombuffer(bytearray(self._states), np.uint8)

    def flagged(self, flag: int) -> NDArray[np.bool_]:
        """[N] true for frames with the flag; a copy."""
        flags: NDArray[np.bool_] = (np.frombuffer(bytes(self._flags), np.uint8) & flag) != 0
        return flags

    def copy(self) -> FrameTable:
        """Copies the table without records of commits, for a thread to read."""
        new = FrameTable(self.scene)
        for name, column in vars(self).items():
            if name != "_records":
                setattr(new, name, copy.copy(column))
        new._notes = copy.deepcopy(self._notes)
        return new

    def take(self, index: int, time: float, identity: str, files: tuple[str, ...], parts: OpenFrame | None) -> None:
        """Queues an acknowledged frame."""
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
        """Puts the frame in another state."""
        if index < self.first and state in (FrameState.QUEUED, FrameState.COMMITTED):
            state = FrameState.FAILED
        before = STATES[self._states[index]]
        self.counts[before] -= 1
        self.counts[state] += 1
        self._states[index] = CODES[state]
        if FrameState.COMMITTED in (before, state):
            self._list(index, state == FrameState.COMMITTED and not self._flags[index] & (DELETED | UNREADABLE))

    def begin_again(self, first: int) -> None:
        """Queues all frames again whose pictures are held, from `first` on; what happened to frames is forgotten.

        Frames that are missing or skipped stay so; all others fail.
        """
        states = self.states()
        stay = (states == CODES[FrameState.MISSING]) | (states == CODES[FrameState.SKIPPED])
        states[~stay] = CODES[FrameState.FAILED]
        states[[i for i in self._files if i >= first and not stay[i]]] = CODES[FrameState.QUEUED]
        self.first, self._states = first, bytearray(states.tobytes())
        self._flags = bytearray(flags & (TIME | RECEIPT) if flags & RECEIPT else 0 for flags in self._flags)
        self.counts = {state: int((states == code).sum()) for state, code in CODES.items()}
        self.committed = array("q")
        self._records.clear()
        notes, self._notes = self._notes, {}
        for index, note in notes.items():
            if stay[index] or note.parts is not None:
                self._notes[index] = Note(note.error if stay[index] else None, parts=note.parts)
        bare = (states == CODES[FrameState.FAILED]) & self.flagged(RECEIPT)
        for index in (np.flatnonzero(bare[first:]) + first).tolist():
            self.note(index).error = BARE

    def found(self, index: int, time: float | None) -> None:
        """Notes a committed state of which nothing else is known."""
        if time is not None:
            self._times[index] = time
            self._flags[index] |= TIME
        if index in self._notes:
            self._notes[index].error = None
        self.move(index, FrameState.COMMITTED)

    def set_unreadable(self, index: int, unreadable: bool) -> None:
        """Marks a committed state that is damaged and being made again, or clears the mark."""
        self._flags[index] = self._flags[index] | UNREADABLE if unreadable else self._flags[index] & ~UNREADABLE
        self.move(index, STATES[self._states[index]])

    def skip(self, index: int, by: int) -> None:
        """Marks the frame as skipped for frame `by`."""
        self._skipped_by[index] = by
        self.move(index, FrameState.SKIPPED)

    def delete_states(self, indices: Sequence[int]) -> int:
        """Marks committed states as gone; returns how many were not marked before."""
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
        """Clears the marks of a frame that will be updated again; returns whether its state was gone."""
        gone = bool(self._flags[index] & DELETED)
        self._flags[index] &= ~(DELETED | UNREADABLE)
        if index in self._notes:
            self._notes[index].error = None
        return gone

    def commit_up_to(self, last: int) -> None:
        """Commits all queued and updating frames up to `last`: many at once, after a start."""
        states = np.frombuffer(self._states, np.uint8)
        for state in (FrameState.QUEUED, FrameState.UPDATING):
            rows = np.flatnonzero(states[: last + 1] == CODES[state])
            states[rows] = CODES[FrameState.COMMITTED]
            self.counts[state] -= len(rows)
            self.counts[FrameState.COMMITTED] += len(rows)
        del states  # the column cannot grow while it is looked at
        self._list_all()

    def set_files(self, index: int, files: tuple[str, ...]) -> None:
        """Sets the frame's records in the frame log; without any, its parts are forgotten too."""
        if files:
            self._files[index] = files
            return
        self._files.pop(index, None)
        if (note := self._notes.get(index)) is not None:
            note.parts = None
            if note == Note():
                del self._notes[index]

    def note(self, index: int) -> Note:
        """Returns the frame's note, to be changed."""
        return self._notes.setdefault(index, Note())

    def set_record(self, index: int, record: Mapping[str, Any]) -> None:
        """Keeps the record of a commit (`History.report`)."""
        self._records[index] = record
        self._records.move_to_end(index)
        while len(self._records) > RECORDS_KEPT:
            self._records.popitem(last=False)

    def remember(self, index: int, record: Mapping[str, Any]) -> None:
        """Keeps the record of an older commit where there is room: the newest stay."""
        if record and index not in self._records and len(self._records) < RECORDS_KEPT:
            self._records[index] = record
            self._records.move_to_end(index, last=False)

    def amend(self, index: int, record: Mapping[str, Any]) -> None:
        """Replaces the record of a commit whose state was made again."""
        if index in self._records:
            self._records[index] = record
        else:
            self.remember(index, record)

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
    """One closed frame: a view into the table."""

    __slots__ = ("_table", "index")

    def __init__(self, table: FrameTable, index: int) -> None:
        self._table = table
        self.index = index

    @property
    def state(self) -> FrameState:
        """State of the frame."""
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
        """Identity as in the receipt; None where the frame never came or its receipt is lost."""
        if not self._table._flags[self.index] & RECEIPT:
            return None
        return self._table._identities[IDENTITY * self.index : IDENTITY * (self.index + 1)].hex()

    @property
    def receipt(self) -> FrameReceipt | None:
        """Receipt that its sender got; None where the frame never came, or the receipt is lost."""
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
        """Names of its records in the frame log; none once they are deleted."""
        return self._table._files.get(self.index, ())

    @property
    def note(self) -> Note:
        """Rare properties, to be read only: changes may be lost."""
        return self._table._notes.get(self.index) or Note()

    @property
    def error(self) -> str | None:
        """Reason why it failed, was skipped, or is missing."""
        if (error := self.note.error) is not None:
            return error
        if self.state == FrameState.SKIPPED:
            return f"skipped: frame {self.skipped_by} came and the queue was full"
        if self.state == FrameState.FAILED and self.index < self._table.first:
            return f"the reconstruction begins with frame {self._table.first}"
        return LOST if self.state == FrameState.FAILED else None

    @property
    def record(self) -> Mapping[str, Any] | None:
        """LogRecord of its commit, where that is in memory."""
        return self._table._records.get(self.index)

    @property
    def report(self) -> FrameReportModel:
        """Report on the wire, with the record of its commit where that is in memory."""
        return self.report_with(self.record)

    def report_with(self, record: Mapping[str, Any] | None) -> FrameReportModel:
        """Report on the wire, with the record of its commit; None: of a frame that is not committed, or not read."""
        note = self.note
        return FrameReportModel(
            scene=self._table.scene,
            index=self.index,
            time=self.time,
            state=self.state,
            error=self.error,
            identity=self.identity,
            attempts=note.own_deaths + note.other_deaths,
            pictures_kept=bool(self.files),
            deleted=self.deleted,
            **({"dropped_cameras": dict(note.dropped)} if record is None else committed_fields(record)),
        )
