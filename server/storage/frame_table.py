"""Table of the frames of a scene, stored in columns. The table accesses neither disk nor clock.

A scene that runs for a day at 30 fps has 2.6 million frames, so each frame permanently takes only
54 bytes. Rare properties (errors, names of frame log records, worker crashes) are stored in
dictionaries. The commit records of the newest frames stay in memory. The commit records of older
frames are read from disk.
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
from scas4d_core.frame_times import FrameTime
from server.storage.events import OpenFrame, RareProperties
from server.storage.report_fields import committed_fields

RECORDS_KEPT = 512
"""Number of newest commit records kept in memory."""
RECORD_LOST = "the journal record of this frame is damaged, so it is unknown what was sent"
PICTURES_GONE = "the reconstruction was restarted after the images of this frame had been deleted"
STATES = tuple(FrameState)
CODES = {state: code for code, state in enumerate(STATES)}
TIME, RECEIPT, DELETED, UNREADABLE = 1, 2, 4, 8
"""Frame flags.

TIME: the frame has a time. RECEIPT: it was acknowledged and has an identity. DELETED: its committed state no longer
exists. UNREADABLE: its state is damaged and is being recomputed.
"""
IDENTITY = 32  # bytes
FEW_STATES = 32
"""Minimum number of deleted states at which the list of committed frames is rebuilt instead of edited."""


class FrameTable:
    """Table of the frames of one scene. The frame indices have no gaps.

    Attributes:
        counts: number of frames in each state.
        committed: indices of frames with a readable committed state, in ascending order.
        received: number of acknowledged frames.
        first: index of the first frame of the reconstruction. Earlier frames have the state FAILED,
            unless they are missing or skipped.
    """

    def __init__(self, scene: str) -> None:
        self.scene = scene
        self.counts = dict.fromkeys(FrameState, 0)
        self.committed: array[int] = array("q")
        self.received = 0
        self.first = 0
        self._states = bytearray()
        self._flags = bytearray()
        self._times = array("d")
        self._sent = array("d")
        self._identities = bytearray()
        self._skipped_by = array("i")
        self._files: dict[int, tuple[str, ...]] = {}
        self._notes: dict[int, RareProperties] = {}
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
        """Returns the frame, or None if it is not closed yet."""
        return FrameEntry(self, index) if index in self else None

    def grow(self, count: int) -> None:
        """Grows the table to `count` frames; new frames have no data and the state FAILED."""
        new = count - len(self)
        if new > 0:
            self._states.extend(bytes([CODES[FrameState.FAILED]]) * new)
            self._flags.extend(bytes(new))
            self._times.frombytes(bytes(8 * new))
            self._sent.frombytes(bytes(8 * new))
            self._identities.extend(bytes(IDENTITY * new))
            self._skipped_by.frombytes(bytes(self._skipped_by.itemsize * new))
            self.counts[FrameState.FAILED] += new

    def with_pictures(self) -> Iterator[FrameEntry]:
        """Yields the frames that have records in the frame log, in ascending order."""
        return (FrameEntry(self, index) for index in sorted(self._files))

    @property
    def pictures_deleted(self) -> int:
        """Number of acknowledged frames whose images are no longer stored."""
        return self.received - len(self._files)

    def states(self) -> NDArray[np.uint8]:
        """Returns a copy of the frame states [N], as indices into `STATES`."""
        return np.frombuffer(bytearray(self._states), np.uint8)

    def flagged(self, flag: int) -> NDArray[np.bool_]:
        """Returns a new mask [N] that is true for the frames with the flag set."""
        flags: NDArray[np.bool_] = (np.frombuffer(bytes(self._flags), np.uint8) & flag) != 0
        return flags

    def copy(self) -> FrameTable:
        """Returns a copy without commit records, for reading in another thread."""
        new = FrameTable(self.scene)
        for name, column in vars(self).items():
            if name != "_records":
                setattr(new, name, copy.copy(column))
        new._notes = copy.deepcopy(self._notes)
        return new

    def enqueue(self, time: FrameTime, identity: str, files: tuple[str, ...], parts: OpenFrame | None) -> None:
        """Queues an acknowledged frame.

        Args:
            time: index and times of the frame.
            identity: identity from the receipt, a hexadecimal digest.
            files: names of the frame's records in the frame log.
            parts: uploads of the single cameras, or None if the frame was uploaded as a whole.
        """
        index = time.index
        self._times[index], self._sent[index] = time.time, time.sent
        self.received += not self._flags[index] & RECEIPT
        self._flags[index] |= TIME | RECEIPT
        self._identities[IDENTITY * index : IDENTITY * (index + 1)] = bytes.fromhex(identity)
        self._files[index] = files
        if index in self._notes:
            self._notes[index].error = None
        if parts is not None:
            self.rare_properties(index).parts = parts
        self.set_state(index, FrameState.QUEUED)

    def set_state(self, index: int, state: FrameState) -> None:
        """Sets the state of a frame.

        A frame before `first` gets the state FAILED instead of QUEUED or COMMITTED.
        """
        if index < self.first and state in (FrameState.QUEUED, FrameState.COMMITTED):
            state = FrameState.FAILED
        before = STATES[self._states[index]]
        self.counts[before] -= 1
        self.counts[state] += 1
        self._states[index] = CODES[state]
        if FrameState.COMMITTED in (before, state):
            self._list(index, state == FrameState.COMMITTED and not self._flags[index] & (DELETED | UNREADABLE))

    def restart(self, first: int) -> None:
        """Resets the table for a reconstruction that starts at frame `first`.

        Frames from `first` on are queued again if their images are still stored. Missing and skipped frames keep their
        state, and all others fail.
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
                self._notes[index] = RareProperties(note.error if stay[index] else None, parts=note.parts)
        bare = (states == CODES[FrameState.FAILED]) & self.flagged(RECEIPT)
        for index in (np.flatnonzero(bare[first:]) + first).tolist():
            self.rare_properties(index).error = PICTURES_GONE

    def add_committed(self, index: int, time: float | None) -> None:
        """Marks a frame as committed whose state was found on disk but not in the journal."""
        if time is not None:
            self._times[index] = self._sent[index] = time
            self._flags[index] |= TIME
        if index in self._notes:
            self._notes[index].error = None
        self.set_state(index, FrameState.COMMITTED)

    def set_unreadable(self, index: int, unreadable: bool) -> None:
        """Sets or clears the flag of a damaged committed state that is being recomputed."""
        self._flags[index] = self._flags[index] | UNREADABLE if unreadable else self._flags[index] & ~UNREADABLE
        self.set_state(index, STATES[self._states[index]])

    def skip(self, index: int, by: int) -> None:
        """Marks the frame as skipped because the queue was full when frame `by` arrived."""
        self._skipped_by[index] = by
        self.set_state(index, FrameState.SKIPPED)

    def delete_states(self, indices: Sequence[int]) -> int:
        """Marks committed states as deleted.

        Returns:
            The number of states that were not marked as deleted before.
        """
        new = 0
        for index in indices:
            new += not self._flags[index] & DELETED
            self._flags[index] |= DELETED
        if len(indices) < FEW_STATES:
            for index in indices:
                self._list(index, False)
        else:
            self._list_all()
        return new

    def restore_state(self, index: int) -> bool:
        """Clears the flags and the error of a frame that will be updated again.

        Returns:
            Whether the state of the frame was marked as deleted.
        """
        gone = bool(self._flags[index] & DELETED)
        self._flags[index] &= ~(DELETED | UNREADABLE)
        if index in self._notes:
            self._notes[index].error = None
        return gone

    def commit_up_to(self, last: int) -> None:
        """Marks all queued and updating frames up to and including frame `last` as committed.

        This method is called when the frames are reconciled with the committed states on disk.
        """
        states = np.frombuffer(self._states, np.uint8)
        for state in (FrameState.QUEUED, FrameState.UPDATING):
            rows = np.flatnonzero(states[: last + 1] == CODES[state])
            states[rows] = CODES[FrameState.COMMITTED]
            self.counts[state] -= len(rows)
            self.counts[FrameState.COMMITTED] += len(rows)
        del states  # a bytearray cannot grow while a view of it exists
        self._list_all()

    def index_at(self, sent: float) -> int | None:
        """Returns the index of the newest frame that was sent with this time in seconds, or None."""
        indices: list[int] = np.flatnonzero(np.frombuffer(self._sent) == sent).tolist()
        return next((index for index in reversed(indices) if self._flags[index] & TIME), None)

    def set_files(self, index: int, files: tuple[str, ...]) -> None:
        """Sets the names of the frame's records in the frame log; an empty tuple also removes its parts."""
        if files:
            self._files[index] = files
            return
        self._files.pop(index, None)
        if (note := self._notes.get(index)) is not None:
            note.parts = None
            if note == RareProperties():
                del self._notes[index]

    def rare_properties(self, index: int) -> RareProperties:
        """Returns the rare properties of the frame, which the caller may modify.

        The properties are created if the frame has none.
        """
        return self._notes.setdefault(index, RareProperties())

    def set_record(self, index: int, record: Mapping[str, Any]) -> None:
        """Stores the commit record of a frame (`History.report`).

        If more than `RECORDS_KEPT` records are stored, the oldest record is evicted.
        """
        self._records[index] = record
        self._records.move_to_end(index)
        while len(self._records) > RECORDS_KEPT:
            self._records.popitem(last=False)

    def cache_record(self, index: int, record: Mapping[str, Any]) -> None:
        """Stores the record of an older commit if fewer than `RECORDS_KEPT` records are stored."""
        if record and index not in self._records and len(self._records) < RECORDS_KEPT:
            self._records[index] = record
            self._records.move_to_end(index, last=False)

    def replace_record(self, index: int, record: Mapping[str, Any]) -> None:
        """Replaces the commit record of a frame whose state was recomputed."""
        if index in self._records:
            self._records[index] = record
        else:
            self.cache_record(index, record)

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
    """View of one closed frame in the table."""

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
        """Whether the frame is in a final state."""
        return self.state in FINISHED

    @property
    def deleted(self) -> bool:
        """Whether the frame was committed and its state no longer exists."""
        return bool(self._table._flags[self.index] & DELETED)

    @property
    def unreadable(self) -> bool:
        """Whether the frame was committed and its damaged state is being recomputed."""
        return bool(self._table._flags[self.index] & UNREADABLE)

    @property
    def time(self) -> float | None:
        """Time of the frame in seconds, or None if it never arrived."""
        return self._table._times[self.index] if self._table._flags[self.index] & TIME else None

    @property
    def times(self) -> FrameTime | None:
        """Time of the frame and the time that was sent, or None if it never arrived."""
        time = self.time
        return None if time is None else FrameTime(self.index, time, self._table._sent[self.index])

    @property
    def identity(self) -> str | None:
        """Identity from the receipt, or None if the frame never arrived or its receipt is lost."""
        if not self._table._flags[self.index] & RECEIPT:
            return None
        return self._table._identities[IDENTITY * self.index : IDENTITY * (self.index + 1)].hex()

    @property
    def receipt(self) -> FrameReceipt | None:
        """Receipt that was sent to the client, or None if the frame never arrived or the receipt is lost."""
        identity, time = self.identity, self.time
        if identity is None or time is None:
            return None
        return FrameReceipt(scene=self._table.scene, index=self.index, time=time, identity=identity)

    @property
    def skipped_by(self) -> int:
        """Index of the frame that caused the skip; meaningful only for a skipped frame."""
        return self._table._skipped_by[self.index]

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the frame's records in the frame log; empty after they are deleted."""
        return self._table._files.get(self.index, ())

    @property
    def rare_properties(self) -> RareProperties:
        """Rare properties of the frame; treat them as read-only, because changes may be lost."""
        return self._table._notes.get(self.index) or RareProperties()

    @property
    def error(self) -> str | None:
        """Reason why the frame failed, was skipped or is missing, or None."""
        if (error := self.rare_properties.error) is not None:
            return error
        if self.state == FrameState.SKIPPED:
            return f"skipped because the queue was full when frame {self.skipped_by} arrived"
        if self.state == FrameState.FAILED and self.index < self._table.first:
            return f"the reconstruction starts with frame {self._table.first}"
        return RECORD_LOST if self.state == FrameState.FAILED else None

    @property
    def record(self) -> Mapping[str, Any] | None:
        """Commit record of the frame, or None if the record is not in memory."""
        return self._table._records.get(self.index)

    @property
    def report(self) -> FrameReportModel:
        """API report of the frame, including its commit record if the record is in memory."""
        return self.report_with(self.record)

    def report_with(self, record: Mapping[str, Any] | None) -> FrameReportModel:
        """Returns the API report of the frame with a commit record, or without one if `record` is None."""
        note = self.rare_properties
        return FrameReportModel(
            scene=self._table.scene,
            index=self.index,
            time=self.time,
            state=self.state,
            error=self.error,
            identity=self.identity,
            worker_deaths=note.own_deaths + note.other_deaths,
            pictures_kept=bool(self.files),
            deleted=self.deleted,
            **({"dropped_cameras": dict(note.dropped)} if record is None else committed_fields(record)),
        )
