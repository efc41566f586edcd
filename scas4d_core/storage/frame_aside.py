"""Frames of a history in memory whose arrays are in a scratch file instead: read anew whenever they are asked for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, MutableMapping, Sequence
from pathlib import Path
from tempfile import TemporaryFile
from threading import Lock
from typing import IO, Any
from weakref import finalize

import numpy as np
from numpy.typing import NDArray

IN_MEMORY = 16
"""Newest states of a history without a directory that stay in memory; older ones go to a scratch file."""


class ScratchFile:
    """A file without a name: nothing of it is left however the process ends. It is neither synced nor checked.

    Args:
        within: a folder on the disk that it takes room of; the file is made once it is needed. None: that of the system
            for temporary files.
    """

    def __init__(self, within: Path | None) -> None:
        self._within = within
        self._file: IO[bytes] | None = None
        self._end = 0
        self._full = False
        self._one_at_a_time = Lock()

    def moved(self, frame: Mapping[str, NDArray[Any]]) -> Mapping[str, NDArray[Any]]:
        """The arrays of a frame, in the file; as they were once there is no room, which is asked for once."""
        if isinstance(frame, FrameAside) or self._full:
            return frame
        try:
            return FrameAside(self, {name: self.put(array) for name, array in frame.items()}, frame)
        except OSError:
            self._full = True
            return frame

    def take(
        self,
        indices: Sequence[int],
        frames: MutableMapping[int, Mapping[str, NDArray[Any]]],
        texts: MutableMapping[int, bytes],
        told: MutableMapping[int, Mapping[str, NDArray[np.uint8]]],
    ) -> None:
        """Moves frames and their reports, from ``texts`` to ``told``; those before one that is here already are, too.

        Args:
            indices: of the frames, rising.
        """
        for index in reversed(indices):
            if (moved := self.moved(frames[index])) is frames[index]:
                break
            frames[index] = moved
            told[index] = self.moved({"report": np.frombuffer(texts.pop(index), np.uint8)})

    def put(self, array: NDArray[Any]) -> int:
        """Adds an array, and says where it begins.

        Raises:
            OSError: no room.
        """
        with self._one_at_a_time:
            if self._file is None:
                self._file = TemporaryFile(dir=self._within, buffering=0)  # noqa: SIM115
                finalize(self, self._file.close)
            begins = self._end
            self._file.seek(begins)
            array.tofile(self._file)
            self._end = begins + array.nbytes
            return begins

    def get(self, begins: int, dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
        """The array that begins there."""
        with self._one_at_a_time:
            assert self._file is not None
            self._file.seek(begins)
            found = np.fromfile(self._file, dtype, int(np.prod(shape)))
        return found.reshape(shape)


class FrameAside(Mapping[str, NDArray[Any]]):
    """The arrays of one frame, in a scratch file.

    Args:
        file: that holds them. begins: by name. frame: the arrays, for their types and shapes.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     frame = {"means": np.arange(6.0).reshape(2, 3), "weights": np.ones(2, "f4")}
    ...     dict(ScratchFile(Path(folder)).moved(frame))
    {'means': array([[0., 1., 2.],
           [3., 4., 5.]]), 'weights': array([1., 1.], dtype=float32)}
    """

    def __init__(self, file: ScratchFile, begins: Mapping[str, int], frame: Mapping[str, NDArray[Any]]) -> None:
        self._file = file
        self._places = {name: (begins[name], array.dtype, array.shape) for name, array in frame.items()}

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self._file.get(*self._places[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)
