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

from scas4d_core.compact.encoder import ERRORS, KEY_EVERY, FrameEncoder
from scas4d_core.compact.head import FileHeader
from scas4d_core.compact.index import footer, index_body
from scas4d_core.compact.planes import pack
from scas4d_core.compact.reader import STATES, CompactReader
from scas4d_core.compact.records import FileError, Record, RecordKind, parse_head, record_bytes
from scas4d_core.gaussians import Gaussians


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
        self.path = Path(path)
        self._encoder = FrameEncoder(head, self.path.name, key_every, clustered=clustered)
        text = head.text()  # serialized first, so an invalid header creates no file
        self.errors: dict[str, float] = {}
        self._file: BinaryIO = self.path.open("xb")
        self._records: list[Record] = []
        self._record: Record | None = None
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
        writer.path, writer.errors = Path(path), {}
        writer._encoder = FrameEncoder.resume(last, writer.path.name, key_every)
        writer._records, writer._record = list(last.records), last.record
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
        records, errors = self._encoder.encode(index, time, state, note)
        for record in records:
            self._append(record)
        self._record = self._records[-1]
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
        known = self._encoder.count
        if index != self.last_frame or values.shape != (known,):
            raise FileError(
                f"{self.path.name}: part labels of shape {values.shape} for frame {index} do not match the last frame, "
                f"{self.last_frame}, which has {known} Gaussians"
            )
        self._append(record_bytes(RecordKind.PARTS, len(values).to_bytes(4, "little") + pack(values + 1), index))

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
    def head(self) -> FileHeader:
        """Header of the file."""
        return self._encoder.head

    @property
    def frames(self) -> int:
        """Number of frames written."""
        return sum(record.kind in STATES for record in self._records) + (self._record is not None)

    @property
    def last_frame(self) -> int:
        """Index of the last frame, or −1 if there is none."""
        return -1 if self._record is None else self._record.frame

    def sync(self) -> None:
        """Flushes all written data to disk (fsync)."""
        os.fsync(self._file.fileno())

    def abandon(self) -> None:
        """Closes the file without an index, even after a disk error; the file can be resumed later."""
        with suppress(OSError):
            self._file.close()

    def _note_errors(self, errors: Mapping[str, float]) -> None:
        for name, value in errors.items():
            self.errors[name] = max(value, self.errors.get(name, 0.0))

    def _append(self, data: bytes) -> None:
        offset = self._file.tell()
        self._file.write(data)
        self._file.flush()
        self._records.append(parse_head(data, 0, self.path.name).at(offset))
