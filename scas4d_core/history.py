"""Θ_0 … Θ_t: the committed states of a scene, in memory or in a directory. Numpy only.

On disk a history is ``fixed.npz`` (opacities and ids, written once) and one ``frame_<index>.npz`` a committed frame.
Every file is written beside its place, synced and renamed, so that a file with its final name is whole; the
directory listing is the only index there is.
"""

from __future__ import annotations

import os
import re
import zipfile
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.gaussians import Gaussians

PER_FRAME = ("means", "rotations", "factors", "colours", "foreground")
"""Arrays of ``Gaussians`` that may differ from frame to frame."""
FIXED = ("opacities", "ids")
"""Arrays of ``Gaussians`` that a scene keeps after frame 0."""
FRAMES_KEPT = 4
"""Frames of a history on disk that stay in memory: the newest, and the last ones asked for."""

_FRAME_FILE = re.compile(r"frame_(\d{6,})\.npz")


class HistoryError(ValueError):
    """A history that cannot be extended or read: the message names the frame or file, the fault and the remedy."""


class History:
    """The committed states of one scene, in the order of their indices.

    Args:
        directory: where the frames are kept, made when missing; without it they stay in memory. A directory that
            already holds a history is opened with ``History.load``.

    Raises:
        HistoryError: ``directory`` already holds a history.
    """

    def __init__(self, directory: Path | str | None = None) -> None:
        self.directory = None if directory is None else Path(directory)
        self._fixed: dict[str, NDArray[Any]] = {}
        self._times: dict[int, float] = {}
        self._frames: OrderedDict[int, dict[str, NDArray[Any]]] = OrderedDict()
        if self.directory is not None:
            self.directory.mkdir(parents=True, exist_ok=True)
            if (self.directory / "fixed.npz").exists():
                raise HistoryError(f"{self.directory} already holds a history; open it with History.load or empty it")

    @classmethod
    def load(cls, directory: Path | str) -> History:
        """Opens the history in a directory; ``append`` goes on behind its last frame.

        Raises:
            HistoryError: no history there, or a file is damaged.
        """
        folder = Path(directory)
        if not (folder / "fixed.npz").exists():
            raise HistoryError(f"{folder} holds no history: fixed.npz is missing")
        history = cls()
        history.directory = folder
        history._fixed = _read(folder / "fixed.npz", FIXED)
        names = sorted((int(m[1]), f.name) for f in folder.iterdir() if (m := _FRAME_FILE.fullmatch(f.name)))
        for index, name in names:
            history._times[index] = float(_read(folder / name, ("time",))["time"])
        return history

    def save(self, directory: Path | str) -> None:
        """Writes a copy of this history into another directory, one frame at a time."""
        copy = History(directory)
        for index in self.indices:
            copy.append(index, self._times[index], self.gaussians(index))

    def append(self, index: int, time: float, gaussians: Gaussians) -> None:
        """Commits the state of one frame; when this returns it is on disk (where there is a directory).

        Args:
            index: frame number, above every index before it.
            time: seconds.
            gaussians: the state; same ids and opacities as in the first frame. The arrays are copied.

        Raises:
            HistoryError: index not above the last, another number of Gaussians, other ids or opacities.
        """
        if self._times and index <= self.indices[-1]:
            raise HistoryError(f"frame {index} comes after frame {self.indices[-1]}; append frames in rising order")
        arrays = gaussians.arrays()
        if not self._fixed:
            fixed = {name: np.array(arrays[name]) for name in FIXED}
            if self.directory is not None:
                _write(self.directory / "fixed.npz", fixed)
            self._fixed = fixed
        for name in FIXED:
            if not np.array_equal(arrays[name], self._fixed[name]):
                raise HistoryError(
                    f"frame {index}: {name} differ from those of the first frame; they are fixed within one history"
                )
        count = len(self._fixed["ids"])
        for name in PER_FRAME:
            if len(arrays[name]) != count:
                raise HistoryError(f"frame {index}: {name} has {len(arrays[name])} rows; give {count}, one a Gaussian")
        frame = {name: np.array(arrays[name]) for name in PER_FRAME}
        if self.directory is not None:
            _write(self._file(index), {**frame, "time": np.float64(time)})
        self._times[index] = float(time)
        self._keep(index, frame)

    def __len__(self) -> int:
        return len(self._times)

    @property
    def indices(self) -> list[int]:
        """The committed frame numbers, rising."""
        return list(self._times)

    @property
    def times(self) -> NDArray[np.float64]:
        """[T] float64 seconds, in the order of ``indices``."""
        return np.array(list(self._times.values()), dtype=np.float64)

    def time(self, index: int) -> float:
        """Seconds of one committed frame."""
        self._require(index)
        return self._times[index]

    def gaussians(self, index: int) -> Gaussians:
        """The state of one committed frame; the arrays are the history's own and must not be written to.

        Raises:
            HistoryError: the frame was not committed, or its file is damaged.
        """
        self._require(index)
        frame = self._frames.get(index)
        if frame is None:
            frame = _read(self._file(index), PER_FRAME)
            self._keep(index, frame)
        else:
            self._frames.move_to_end(index)
        return Gaussians(**frame, **self._fixed)

    def stacked(
        self, name: str, indices: Sequence[int] | None = None, rows: NDArray[np.intp] | None = None
    ) -> NDArray[Any]:
        """One array of several frames, [T, N, ...], in the order of ``indices`` (default: every frame).

        Reads only that array of the files, so that a long history needs no more memory than the answer.

        Args:
            name: one of ``PER_FRAME``.
            indices: committed frames; may repeat.
            rows: Gaussians by row, any shape; the answer is then [T, *rows.shape, ...].

        Raises:
            HistoryError: ``name`` is not in ``PER_FRAME``, or a frame was not committed.
        """
        if name not in PER_FRAME:
            raise HistoryError(f"{name!r} is not kept per frame; ask for one of {', '.join(PER_FRAME)}")
        chosen = self.indices if indices is None else list(indices)
        if not chosen:
            raise HistoryError("indices is empty; name at least one committed frame")
        result: NDArray[Any] | None = None
        for row, index in enumerate(chosen):
            self._require(index)
            frame = self._frames.get(index)
            array = frame[name] if frame is not None else _read(self._file(index), (name,))[name]
            if rows is not None:
                array = array[rows]
            if result is None:
                result = np.empty((len(chosen), *array.shape), dtype=array.dtype)
            result[row] = array
        assert result is not None
        return result

    def _require(self, index: int) -> None:
        if index not in self._times:
            held = f"{self.indices[0]} to {self.indices[-1]}" if self._times else "none yet"
            raise HistoryError(f"frame {index} is not in the history; committed frames: {held}")

    def _file(self, index: int) -> Path:
        assert self.directory is not None
        return self.directory / f"frame_{index:06d}.npz"

    def _keep(self, index: int, frame: dict[str, NDArray[Any]]) -> None:
        self._frames[index] = frame
        if self.directory is not None:
            newest = self.indices[-1]
            for old in [i for i in self._frames if i != newest][: max(0, len(self._frames) - FRAMES_KEPT)]:
                del self._frames[old]


def moving_extent(gaussians: Gaussians) -> float:
    """Longest side, in metres, of the box that holds 98 % of the moving Gaussians on each axis (of all if none moves).

    The unit of tolerances and features that should not depend on the size of the scene; the few Gaussians that
    stray do not change it.
    """
    means = gaussians.means[gaussians.moving] if gaussians.moving.any() else gaussians.means
    low, high = np.percentile(means, (1, 99), axis=0)
    return float(np.max(high - low))


def _write(path: Path, arrays: dict[str, Any]) -> None:
    """Writes an npz that is either whole at ``path`` or not there: temporary file, sync, rename, sync of the folder."""
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with beside.open("wb") as file:
            np.savez(file, **arrays)
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise
    if os.name == "posix":  # elsewhere a directory cannot be opened to be synced
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def _read(path: Path, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Named arrays of an npz; zip's own checksums find damage."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in names}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise HistoryError(f"{path}: no readable history file ({error}); restore it or start the scene anew") from error
