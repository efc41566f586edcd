"""Scratch files for frames of an in-memory history. Frames in a scratch file are read again on every access."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryFile
from threading import Lock
from typing import IO, Any
from weakref import finalize

import numpy as np
from numpy.typing import NDArray

ROUNDED = 512
"""Block sizes are multiples of this number of bytes."""
IN_MEMORY = 16
"""Number of newest states that a history without a directory keeps in memory; older states go to a scratch file."""


class ScratchFile:
    """Unnamed temporary file for frames, which is removed even if the process crashes.

    The file is neither synced nor checksummed.

    Args:
        within: folder in which the file is created on first use, or None for the system's temporary folder.
    """

    def __init__(self, within: Path | None) -> None:
        self._within = within
        self._file: IO[bytes] | None = None
        self._end = 0
        self._free: dict[int, list[int]] = {}
        """Offsets of free blocks, keyed by block size."""
        self._full = False
        self._one_at_a_time = Lock()

    def store(self, frame: Mapping[str, NDArray[Any]]) -> Mapping[str, NDArray[Any]]:
        """Moves the arrays of a frame to the file, and returns the frame as a ``ScratchFrame``.

        If the disk is full, or the frame has already been moved, it is returned unchanged.
        """
        if isinstance(frame, ScratchFrame) or self._full:
            return frame
        try:
            return ScratchFrame(self, {name: self.put(array) for name, array in frame.items()}, frame)
        except OSError:
            self._full = True
            return frame

    def put(self, array: NDArray[Any]) -> int:
        """Adds an array to the file and returns its offset.

        Raises:
            OSError: if the file cannot be written, for example because the disk is full.
        """
        with self._one_at_a_time:
            if self._file is None:
                self._file = TemporaryFile(dir=self._within, buffering=0)  # noqa: SIM115
                finalize(self, self._file.close)
            size = _size_class(array.nbytes)
            free = self._free.get(size)
            begins = free.pop() if free else self._end
            self._write(array.tobytes(), begins)
            self._end = max(self._end, begins + size)
            return begins

    def _write(self, data: bytes, begins: int) -> None:
        assert self._file is not None
        left = memoryview(data)
        while left:  # a nearly full disk may write only a part
            count = os.pwrite(self._file.fileno(), left, begins)
            left, begins = left[count:], begins + count

    def get(self, begins: int, dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
        """Reads the array at an offset of the file."""
        assert self._file is not None
        array = np.empty(shape, dtype)
        left, at = array.reshape(-1).view(np.uint8).data, begins
        while left:
            count = os.preadv(self._file.fileno(), [left], at)
            if count == 0:
                raise OSError(f"unexpected end of the scratch file at byte {at}")
            left, at = left[count:], at + count
        return array

    def free(self, places: Mapping[str, tuple[int, int]]) -> None:
        """Releases blocks, given as (offset, size) in bytes, for reuse.

        This method takes no lock, because the garbage collector may call it at any time.
        """
        for begins, size in places.values():
            self._free.setdefault(_size_class(size), []).append(begins)


def _size_class(size: int) -> int:
    """Returns the block size for an array of ``size`` bytes. Blocks of equal size are interchangeable."""
    return -(-size // ROUNDED) * ROUNDED


class ScratchFrame(Mapping[str, NDArray[Any]]):
    """Mapping from names to the arrays of one frame, which are read from a scratch file.

    Args:
        file: file that contains the arrays.
        begins: offset of each array in the file.
        frame: arrays of the frame; only their dtypes and shapes are used.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     frame = {"means": np.arange(6.0).reshape(2, 3), "weights": np.ones(2, "f4")}
    ...     dict(ScratchFile(Path(folder)).store(frame))
    {'means': array([[0., 1., 2.],
           [3., 4., 5.]]), 'weights': array([1., 1.], dtype=float32)}
    """

    def __init__(self, file: ScratchFile, begins: Mapping[str, int], frame: Mapping[str, NDArray[Any]]) -> None:
        self._file = file
        finalize(self, file.free, {name: (begins[name], array.nbytes) for name, array in frame.items()})
        self._places = {name: (begins[name], array.dtype, array.shape) for name, array in frame.items()}

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self._file.get(*self._places[name])

    def __contains__(self, name: object) -> bool:  # the inherited method would read the array
        return name in self._places

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)
