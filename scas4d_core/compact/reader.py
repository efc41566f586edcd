"""Reads compact files, including truncated files and files that are still being written.

This module requires only NumPy and zstandard.
"""

from __future__ import annotations

from bisect import bisect_right
from itertools import groupby
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

from scas4d_core.compact.birth_code import decode_born
from scas4d_core.compact.cluster_motion import Clusters
from scas4d_core.compact.columns import Columns
from scas4d_core.compact.encoder_state import EncoderState
from scas4d_core.compact.frame_code import FrameDelta, apply_deltas
from scas4d_core.compact.head import FileHeader
from scas4d_core.compact.index import read_index
from scas4d_core.compact.planes import PlaneError, unpack
from scas4d_core.compact.records import (
    HEAD_SIZE,
    MAGIC,
    DamagedFileError,
    FileError,
    Record,
    RecordKind,
    checksum_bytes,
    read_body,
    read_note,
    record_bytes,
    scan,
)
from scas4d_core.gaussians import Gaussians

__all__ = ["CompactReader", "DamagedFileError", "FileError"]

STATES = (RecordKind.KEY, RecordKind.DELTA)
AT_ONCE = 8
"""Maximum number of states decoded together."""
MAX_PER_BYTE = 4
"""Maximum plausible number of Gaussians per byte; prevents a corrupt count from exhausting memory."""


class CompactReader:
    """Reader of a compact file, which can decode the states in any order.

    Args:
        path: path of the file.

    Attributes:
        head: header with the world transform, bounds, background and cameras.
        damage: description of the first damage in the file, or None; frames after the damage are not listed.
        about: JSON values about the whole file, from its index, such as the largest error of each attribute
            (``errors``); empty if there is no index.

    Raises:
        FileNotFoundError: if the file does not exist.
        FileError: if the file is not a compact file.
        DamagedFileError: if the file header is damaged.

    >>> CompactReader("README.md")
    Traceback (most recent call last):
    scas4d_core.compact.records.FileError: README.md is not a compact 4D file: it does not start with b's4dR'
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.damage: str | None = None
        self.about: dict[str, Any] = {}
        self._file: BinaryIO = self.path.open("rb")
        self._records: list[Record] = []
        self._end = 0
        self._whole = False
        self._states: list[Record] = []
        self._frames: list[int] = []
        self._births: list[Record] = []
        self._parts: list[Record] = []
        self._notes: dict[int, Record] = {}
        self._born: tuple[int, Columns, Clusters] | None = None
        self._last: tuple[int, Columns] | None = None
        try:
            if (begin := self._file.read(len(MAGIC))) != MAGIC[: len(begin)] or not begin:
                raise FileError(f"{self.path.name} is not a compact 4D file: it does not start with {MAGIC!r}")
            parts = read_index(self._file, self.path.name)
            if parts is not None:
                records, self.about = parts
                self._whole = True
                try:
                    for record in records:
                        self._note(record)
                except DamagedFileError as error:
                    self.damage = str(error)
            else:
                self.refresh()
            if not self._records or self._records[0].kind is not RecordKind.HEAD:
                raise FileError(
                    f"{self.path.name}: the header is missing{self._why()}; the file is truncated or not yet written"
                )
            self.head = FileHeader.read(read_body(self._file, self._records[0], self.path.name), self.path.name)
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def refresh(self) -> list[int]:
        """Reads the records appended since the last call, and returns the indices of the new frames."""
        if self._whole or self.damage is not None:
            return []
        known = len(self._frames)
        try:
            for record in scan(self._file, self._end, self.path.name):
                self._note(record)
                self._end = record.end
                if record.kind is RecordKind.INDEX:
                    self._whole = True
                    if (whole := read_index(self._file, self.path.name)) is not None:
                        self.about = whole[1]
                    break
        except FileError as error:
            self.damage = str(error)
        return self._frames[known:]

    @property
    def frames(self) -> list[int]:
        """Frame indices in increasing order."""
        return list(self._frames)

    @property
    def times(self) -> NDArray[np.float64]:
        """[T] frame times in seconds, in the order of ``frames``."""
        return np.array([record.time for record in self._states], np.float64)

    @property
    def count(self) -> int:
        """Number of Gaussians in the last frame, including retired ones."""
        return sum(self._born_count(record) for record in self._births)

    def state(self, index: int) -> Gaussians:
        """Returns the state of a frame, in the internal world of ``head.world``.

        The arrays of the state must not be modified.

        Raises:
            FileError: if the file has no such frame.
            DamagedFileError: if bytes needed for the frame are damaged.
        """
        place = bisect_right(self._frames, index) - 1
        if place < 0 or self._frames[place] != index:
            held = f"{self._frames[0]} to {self._frames[-1]}" if self._frames else "none"
            raise FileError(
                f"{self.path.name}: frame {index} is not in the file{self._why()}; available frames: {held}"
            )
        begin = place
        while (
            self._states[begin].kind is RecordKind.DELTA and begin > 0 and not (self._last and self._last[0] == begin)
        ):
            begin -= 1
        state = self._last[1] if self._last is not None and self._last[0] == begin else None
        wanted = range(begin if state is None else begin + 1, place + 1)
        for _, places in groupby(wanted, lambda one: (self._count_births(one), one // AT_ONCE)):
            state = self._decoded(list(places), state)
        assert state is not None
        self._last = (place, state)
        return state.gaussians()

    def copy_records(self, first: int, last: int, file: BinaryIO) -> list[int]:
        """Copies the states of a range of frames to another file.

        States decoded from the copy are bit-identical. The copy has no index, notes or part labels.

        Args:
            first, last: first and last frame, inclusive.
            file: output file.

        Returns:
            Indices of the copied frames, up to the first damaged one. They include frames on which
            the requested frames depend: the first frame of this file, and all frames from the last
            key frame up to ``first``.

        Raises:
            FileError: if no frame is in the range.
            DamagedFileError: if the first frame, or a record that it depends on, is damaged.
        """
        wanted = [place for place, index in enumerate(self._frames) if first <= index <= last]
        if not wanted:
            raise FileError(f"{self.path.name} contains no frames from {first} to {last}{self._why()}")
        begin = next(place for place in range(wanted[0], -1, -1) if self._states[place].kind is not RecordKind.DELTA)
        states = {self._states[place] for place in (0, *range(begin, wanted[-1] + 1))}
        end, copied = self._frames[wanted[-1]], list[int]()
        for record in self._records:
            if (
                record in states
                or record.kind is RecordKind.HEAD
                or (record.kind is RecordKind.BORN and record.frame <= end)
            ):
                try:
                    body = read_body(self._file, record, self.path.name)
                except DamagedFileError:
                    if not copied or copied[-1] < first:
                        raise
                    break
                file.write(record_bytes(record.kind, body, record.frame, record.time))
                copied += [record.frame] if record in states else []
        return copied

    def parts(self, index: int | None = None) -> NDArray[np.int64] | None:
        """Returns the latest part labels [N] stored up to a frame (−1 for no part), or None if there are none."""
        records = [record for record in self._parts if index is None or record.frame <= index]
        if not records:
            return None
        body = read_body(self._file, records[-1], self.path.name)
        count = int.from_bytes(body[:4], "little")
        if count > self.count:
            raise self._damaged(records[-1], PlaneError(f"labels for {count} Gaussians, but only {self.count} exist"))
        try:
            return unpack(body, count, 4)[0].astype(np.int64) - 1
        except PlaneError as error:
            raise self._damaged(records[-1], error) from None

    @property
    def is_closed(self) -> bool:
        """Whether the file is complete, that is, ends with its index."""
        return self._whole

    def encoder_state(self) -> EncoderState:
        """Returns what a writer needs to append to the file. The file must contain a frame."""
        place = len(self._states) - 1
        self.state(self._frames[place])
        record, columns = self._states[place], self._last
        assert columns is not None
        born, clusters = self._newborn_until(record.frame)
        key = next(i for i in range(place, -1, -1) if i == 0 or self._states[i].kind is RecordKind.KEY)
        behind = (record.end, *(one.end for one in self._parts if one.frame == record.frame))
        records = tuple(one for one in self._records if one.end <= max(behind))
        return EncoderState(self.head, records, record, columns[1], born, clusters, place - key)

    def sizes(self) -> list[tuple[int, int, int]]:
        """Returns each state's frame index, bytes since the previous state, and checksum."""
        ends = [0, *(one.end for one in self._states)]
        return [(one.frame, one.end - before, one.checksum) for one, before in zip(self._states, ends, strict=False)]

    def end_before(self, index: int) -> int:
        """Returns the file offset at which the records of a frame begin."""
        return min(one.offset - HEAD_SIZE for one in self._records if one.frame >= index)

    def note(self, index: int) -> dict[str, Any]:
        """Returns a frame's note as a dict of JSON values, or an empty dict if there is no note.

        Raises:
            DamagedFileError: if the note is damaged.
        """
        record = self._notes.get(index)
        if record is None:
            return {}
        try:
            return read_note(read_body(self._file, record, self.path.name))
        except PlaneError as error:
            raise self._damaged(record, error) from None

    def _note(self, record: Record) -> None:
        self._records.append(record)
        if record.kind is RecordKind.BORN:
            self._births.append(record)
            if not self._states:  # the first birth record is also the state of the first frame
                self._states.append(record)
                self._frames.append(record.frame)
        elif record.kind in STATES:
            if not self._frames or record.frame <= self._frames[-1]:
                before = f"after frame {self._frames[-1]}" if self._frames else "before any birth record"
                place = record.offset - HEAD_SIZE
                raise DamagedFileError(f"{self.path.name}: unexpected frame {record.frame} {before}, at byte {place}")
            self._states.append(record)
            self._frames.append(record.frame)
        elif record.kind is RecordKind.PARTS:
            self._parts.append(record)
        elif record.kind is RecordKind.NOTE:
            self._notes[record.frame] = record

    def _count_births(self, place: int) -> int:
        """Returns the number of birth records up to a state, or −1 if the state itself is the birth record."""
        state = self._states[place]
        return -1 if state.kind is RecordKind.BORN else sum(birth.frame <= state.frame for birth in self._births)

    def _decoded(self, places: list[int], before: Columns | None) -> Columns:
        """Decodes consecutive states of the same Gaussians and returns the last. Only the first may be a key frame.

        Args:
            places: indices of the states, in file order.
            before: previous state, or None if it is not decoded.
        """
        first = self._states[places[0]]
        born, clusters = self._newborn_until(first.frame)
        if first.kind is RecordKind.BORN:
            return born
        if first.kind is RecordKind.KEY or before is None:
            before = born
        elif len(before) < len(born):
            before = before.concatenate(born.from_row(len(before)))
        changes = [self._change(place, before, clusters) for place in places]
        try:
            return apply_deltas(before, clusters, self.head.bounds, changes)
        except ValueError as error:
            raise self._damaged(self._states[places[-1]], error) from None

    def _change(self, place: int, reference: Columns, clusters: Clusters) -> FrameDelta:
        """Parses the changes in the record of a state."""
        record = self._states[place]
        body = read_body(self._file, record, self.path.name)
        if record.kind is RecordKind.DELTA:
            expected = checksum_bytes(self._states[place - 1])
            if body[: len(expected)] != expected:
                raise self._damaged(record, PlaneError("it is relative to a different previous state"))
            body = body[len(expected) :]
        try:
            return FrameDelta.read(body, reference, clusters)
        except ValueError as error:
            raise self._damaged(record, error) from None

    def _newborn_until(self, index: int) -> tuple[Columns, Clusters]:
        """Returns all Gaussians born up to a frame, as decoded from their birth records, and their clusters."""
        wanted = [record for record in self._births if record.frame <= index]
        if not wanted:
            raise DamagedFileError(f"{self.path.name}: the Gaussians of frame {index} are missing")
        count = len(wanted)
        known, state, clusters = (0, None, None) if self._born is None or self._born[0] > count else self._born
        for number in range(known, count):
            record = wanted[number]
            body = read_body(self._file, record, self.path.name)
            try:
                own, labels = decode_born(body[4:], self._counted(body, record), self.head.bounds)
            except (PlaneError, ValueError) as error:
                raise self._damaged(record, error) from None
            state = own if state is None else state.concatenate(own)
            clusters = labels if clusters is None else clusters.concatenate(labels.labels)
        assert state is not None
        assert clusters is not None
        self._born = (count, state, clusters)
        return state, clusters

    def _born_count(self, record: Record) -> int:
        self._file.seek(record.offset)
        return int.from_bytes(self._file.read(4), "little")

    def _counted(self, body: bytes, record: Record) -> int:
        """Returns the Gaussian count at the start of a body, after a plausibility check against the body size."""
        count = int.from_bytes(body[:4], "little")
        if len(body) < 4 or count > MAX_PER_BYTE * len(body) + 1024:
            raise self._damaged(record, PlaneError(f"invalid count: {count} Gaussians in {len(body)} bytes"))
        return count

    def _damaged(self, record: Record, error: Exception) -> DamagedFileError:
        place = record.offset - HEAD_SIZE
        return DamagedFileError(
            f"{self.path.name}: the {record.kind.name.lower()} record of frame {record.frame} at byte {place} cannot "
            f"be read ({error})"
        )

    def _why(self) -> str:
        return "" if self.damage is None else f" ({self.damage})"
