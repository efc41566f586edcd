"""Writes a compact file frame by frame; written frames can be read immediately."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

from scas4d_core.compact.birth_code import encode_born
from scas4d_core.compact.cluster_motion import Clusters
from scas4d_core.compact.columns import Columns
from scas4d_core.compact.frame_code import encode, errors_of
from scas4d_core.compact.head import FileHeader
from scas4d_core.compact.index import footer, index_body
from scas4d_core.compact.planes import pack
from scas4d_core.compact.reader import STATES, CompactReader
from scas4d_core.compact.records import (
    FileError,
    Record,
    RecordKind,
    checksum_bytes,
    note_bytes,
    parse_head,
    record_bytes,
)
from scas4d_core.gaussians import Gaussians

ERRORS = "errors"
"""Key under which a note stores the largest errors of its frame."""
KEY_EVERY = 8
"""Interval between key frames, and thus the maximum number of states decoded to access one frame."""


class CompactWriter:
    """Writer of a new compact file, which adds the states of a scene frame by frame.

    Args:
        path: path of the file, which must not exist.
        head: header of the file.
        key_every: interval between key frames.
        clustered: whether to cluster the Gaussians. Clustering dominates the time needed to write a single-frame file,
            but makes further frames smaller.

    Attributes:
        errors: largest error of each attribute so far, in the units of ``Bounds``.

    Raises:
        FileExistsError: if the file exists.
        FileError: if ``key_every`` is less than 1.

    >>> from tempfile import TemporaryDirectory
    >>> from scas4d_core.cameras import WorldFrame
    >>> from scas4d_core.compact import CompactReader
    >>> state = Gaussians.of_points(np.random.default_rng(0).normal(size=(300, 3)), radius=0.1)
    >>> moved = state.replace(means=state.means + np.float32([0, 0, 1]))
    >>> with TemporaryDirectory() as folder:
    ...     with CompactWriter(f"{folder}/a.s4d", FileHeader(WorldFrame(np.zeros(3)))) as writer:
    ...         errors = [writer.add(index, 0.1 * index, each) for index, each in enumerate((state, moved))]
    ...     with CompactReader(f"{folder}/a.s4d") as reader:
    ...         found = reader.state(1).means - reader.state(0).means
    >>> found.mean(axis=0).round(2)[2]
    np.float32(1.0)
    """

    def __init__(
        self, path: Path | str, head: FileHeader, key_every: int = KEY_EVERY, *, clustered: bool = True
    ) -> None:
        if key_every < 1:
            raise FileError(f"key_every must be at least 1; got {key_every}")
        text = head.text()  # serialized first, so an invalid header creates no file
        self.path = Path(path)
        self.head = head
        self.errors: dict[str, float] = {}
        self._key_every = key_every
        self._clustered = clustered
        self._file: BinaryIO = self.path.open("xb")
        self._records: list[Record] = []
        self._born: Columns | None = None
        self._clusters = Clusters(np.zeros(0, np.int64))
        self._last: Columns | None = None
        self._since_key = 0
        self._opacities: NDArray[np.float32] | None = None
        """Exact opacities of all Gaussians so far, or None if unknown."""
        self._record = Record(RecordKind.HEAD, -1, 0.0, 0, 0, 0)
        """The record of the last state."""
        self._append(record_bytes(RecordKind.HEAD, text))

    @classmethod
    def resume(cls, path: Path | str, key_every: int = KEY_EVERY) -> CompactWriter:
        """Resumes an unclosed file after its last complete state.

        Records after that state are discarded, except its part labels.

        ``errors`` covers the existing frames that have a note, and all frames added from now on.

        Raises:
            FileNotFoundError: if the file does not exist.
            FileError: if the file is complete, has no state, or is damaged.
        """
        with CompactReader(path) as reader:
            if reader.is_closed:
                raise FileError(f"{reader.path.name} is already complete; start a new file")
            if reader.damage is not None or not reader.frames:
                raise FileError(f"{reader.path.name} cannot be resumed: {reader.damage or 'it contains no state'}")
            last = reader.encoder_state()
            known = [reader.note(index).get(ERRORS, {}) for index in reader.frames]
        writer = cls.__new__(cls)
        writer.path, writer.head, writer.errors, writer._key_every = Path(path), last.head, {}, key_every
        writer._records, writer._record, writer._since_key = list(last.records), last.record, last.since_key
        writer._born, writer._clusters, writer._last = last.born, last.clusters, last.state
        writer._opacities = None
        for errors in known:
            writer._note_errors(errors)
        writer._file = writer.path.open("r+b")
        writer._file.truncate(last.records[-1].end)
        writer._file.seek(0, 2)
        return writer

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self._file.close()

    def add(
        self, index: int, time: float, state: Gaussians, note: Mapping[str, Any] | None = None
    ) -> Mapping[str, float]:
        """Writes the state of a frame; returns the largest error of each attribute.

        Args:
            index: frame index, greater than all previous ones.
            time: time in seconds.
            state: Gaussians of the previous frame in the same order, followed by newborn ones with new ids.
            note: JSON values about the frame, written before its state along with the frame's ``errors``.

        Raises:
            FileError: if the frame cannot follow the previous frames.
            ValueError: if the note cannot be serialized as JSON.
        """
        self._check(index, state)
        note_bytes(note or {})
        columns, before = Columns.of(state), self._last
        self._opacities = columns.opacities.copy() if self._opacities is None else self._opacities
        records = (
            [] if before is not None and len(state) == len(before) else [(RecordKind.BORN, self._add_newborn(columns))]
        )
        born = self._born
        assert born is not None
        if before is None:
            decoded = born
            errors: Mapping[str, float] = errors_of(born, columns)
        else:
            if len(before) < len(born):
                before = before.concatenate(born.from_row(len(before)))
            key = self._since_key + 1 >= self._key_every
            self._since_key = 0 if key else self._since_key + 1
            coded = encode(born if key else before, columns, self._clusters, self.head.bounds)
            reference = (
                b"" if key else checksum_bytes(self._record)
            )  # lets a reader detect a mismatched reference state
            records.append((RecordKind.KEY if key else RecordKind.DELTA, reference + coded.body))
            decoded, errors = coded.decoded, coded.errors
        if note is not None:
            records.insert(0, (RecordKind.NOTE, note_bytes({**note, ERRORS: dict(errors)})))
        for kind, body in records:
            self._append(record_bytes(kind, body, index, time))
        self._record, self._last = self._records[-1], decoded
        self._note_errors(errors)
        return errors

    def add_parts(self, index: int, labels: NDArray[np.integer]) -> None:
        """Writes the part label of each Gaussian, valid from the last frame onwards.

        Args:
            index: index of the last frame.
            labels: [N] part labels, −1 for none.

        Raises:
            FileError: if the index is not that of the last frame, or the number of labels is wrong.
        """
        values = np.asarray(labels, np.int64)
        known = 0 if self._born is None else len(self._born)
        if index != self._record.frame or values.shape != (known,):
            raise FileError(
                f"{self.path.name}: part labels of shape {values.shape} for frame {index} do not match the last frame, "
                f"{self._record.frame}, which has {known} Gaussians"
            )
        self._append(record_bytes(RecordKind.PARTS, len(values).to_bytes(4, "little") + pack(values + 1), index))

    def _check(self, index: int, state: Gaussians) -> None:
        """Rejects a state that cannot follow the previous ones, before anything is written."""
        last, name = self._record.frame, self.path.name
        if index <= last:
            raise FileError(f"{name}: frame {index} cannot follow frame {last}; add frames in ascending order")
        if not len(state):
            raise FileError(f"{name}: frame {index} has no Gaussians; start with a frame that contains Gaussians")
        if (born := self._born) is not None:
            known = len(born)
            if len(state) < known or not np.array_equal(state.ids[:known], born.ids):
                raise FileError(f"{name}: frame {index} lacks Gaussians of frame {last}; do not remove or reorder any")
            if self._opacities is not None and not np.array_equal(state.own_opacities[:known], self._opacities):
                raise FileError(f"{name}: frame {index} changes opacities from frame {last}; they are fixed at birth")
            if _glossy(state.gloss) != (0 if born.gloss is None else born.gloss.shape[1]):
                raise FileError(
                    f"{name}: frame {index} has gloss for {_glossy(state.gloss)} Gaussians, unlike the first frame"
                )
        for field in ("means", "factors", "rotations", "colours", "own_opacities", "gloss"):
            if (array := getattr(state, field)) is None or np.isfinite(array).all():
                continue
            wrong = np.flatnonzero(~np.isfinite(array).reshape(len(array), -1).all(axis=1))
            raise FileError(
                f"{name}: frame {index}: {len(wrong)} Gaussians have non-finite {field}, rows "
                f"{wrong[:5].tolist()}; omit the frame, or fix these Gaussians"
            )

    def close(self) -> None:
        """Writes the index and closes the file. A file without an index remains readable by scanning its records."""
        if self._file.closed:
            return
        body = index_body(self._records, json.dumps({"errors": self.errors}).encode())
        try:
            offset = self._file.tell()
            self._file.write(record_bytes(RecordKind.INDEX, body) + footer(offset))
        finally:
            self._file.close()

    @property
    def frames(self) -> int:
        """Number of frames written."""
        return sum(record.kind in STATES for record in self._records) + (self._last is not None)

    @property
    def last_frame(self) -> int:
        """Index of the last frame, or −1 if there is none."""
        return self._record.frame

    def sync(self) -> None:
        """Flushes all written data to disk (fsync)."""
        os.fsync(self._file.fileno())

    def abandon(self) -> None:
        """Closes the file without an index, even after a disk error; the file can be resumed later."""
        with suppress(OSError):
            self._file.close()

    def _add_newborn(self, state: Columns) -> bytes:
        """Registers the newborn Gaussians of a state; returns the body of their birth record."""
        if self._last is None:
            born = state
            clusters = Clusters.of(state.gaussians()) if self._clustered else Clusters(np.zeros(len(state), np.int64))
        else:
            born = state.from_row(len(self._last))
            clusters = Clusters(self._clusters.nearest(self._last, born))
        body, decoded = encode_born(born, clusters, self.head.bounds)
        self._born = decoded if self._born is None else self._born.concatenate(decoded)
        self._clusters = self._clusters.concatenate(clusters.labels)
        self._opacities = state.opacities.copy()
        return len(born).to_bytes(4, "little") + body

    def _note_errors(self, errors: Mapping[str, float]) -> None:
        for name, value in errors.items():
            self.errors[name] = max(value, self.errors.get(name, 0.0))

    def _append(self, data: bytes) -> None:
        offset = self._file.tell()
        self._file.write(data)
        self._file.flush()
        self._records.append(parse_head(data, 0, self.path.name).at(offset))


def _glossy(gloss: NDArray[np.float32] | None) -> int:
    return 0 if gloss is None else len(gloss)
