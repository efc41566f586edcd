"""Frames of a history in memory whose arrays are in scratch files instead: read anew whenever they are asked for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import Any
from weakref import finalize

import numpy as np
from numpy.typing import NDArray


class FrameAside(Mapping[str, NDArray[Any]]):
    """The arrays of one frame, in one file. It is neither synced nor checked: it lives as long as this process.

    Args:
        file: that is written. frame: arrays by name.

    Raises:
        OSError: it cannot be written; nothing is left of it then.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     frame = FrameAside(Path(folder) / "0", {"means": np.arange(6.0).reshape(2, 3), "weights": np.ones(2, "f4")})
    ...     dict(frame)
    {'means': array([[0., 1., 2.],
           [3., 4., 5.]]), 'weights': array([1., 1.], dtype=float32)}
    """

    def __init__(self, file: Path, frame: Mapping[str, NDArray[Any]]) -> None:
        self._file = file
        self._places: dict[str, tuple[int, np.dtype[Any], tuple[int, ...]]] = {}
        try:
            with file.open("wb") as opened:
                for name, array in frame.items():
                    self._places[name] = opened.tell(), array.dtype, array.shape
                    opened.write(np.ascontiguousarray(array).data)
        except OSError:
            file.unlink(missing_ok=True)
            raise

    def __getitem__(self, name: str) -> NDArray[Any]:
        offset, dtype, shape = self._places[name]
        return np.fromfile(self._file, dtype, int(np.prod(shape)), offset=offset).reshape(shape)

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)


class ScratchFrames:
    """The scratch files of a history, in a folder of their own that goes with it, or at the end of the process.

    Args:
        within: the folder in which that is made, once it is needed.
    """

    def __init__(self, within: Path) -> None:
        self._within = within
        self._folder: Path | None = None

    def moved(self, index: int, frame: Mapping[str, NDArray[Any]]) -> Mapping[str, NDArray[Any]]:
        """The arrays of a frame in its file; as they were, where there is no room for that."""
        if isinstance(frame, FrameAside):
            return frame
        with suppress(OSError):
            if self._folder is None:
                self._folder = Path(mkdtemp(prefix=".states-", dir=self._within))
                finalize(self, rmtree, self._folder, ignore_errors=True)
            return FrameAside(self._folder / str(index), frame)
        return frame
