"""Keeps the committed states of a scene, Θ_0 … Θ_t, in memory or in a directory. Numpy only.

On disk (``frame_files``) a history is one file with opacities and ids, written once, and one file for each committed
frame, which holds its state, its time and its report; the rename of that file to its final name is the commit. One
process appends and deletes, through a ``History``; others read, and pick up its changes with ``refresh``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from scas4d_core.gaussians import Gaussians
from scas4d_core.storage.frame_files import Arrays, DamagedFrameError, FrameFiles, HistoryError, UnreadableFrameError
from scas4d_core.storage.history_reader import FIXED, FRAMES_KEPT, PER_FRAME, HistoryReader
from scas4d_core.storage.npz import clear_parts

__all__ = [
    "FIXED", "FRAMES_KEPT", "NEWEST_KEPT", "PER_FRAME", "DamagedFrameError", "History", "HistoryError",
    "UnreadableFrameError",
]  # fmt: skip

NEWEST_KEPT = 2
"""Newest states that retention never deletes: should the last be damaged, the scene is resumed from the one before."""


class History(HistoryReader):
    """The committed states of one scene, in the order of their indices; for the process that appends.

    Args:
        directory: made when missing; without it the states stay in memory. A directory that already holds states is
            opened with ``History.load`` or ``History.open``.

    Attributes:
        record_seconds: seconds that the last ``append`` spent on the report: encoding it, and its share of writing, by
            bytes.

    Raises:
        HistoryError: ``directory`` already holds states.

    >>> state = Gaussians.of_points([[0, 0, 2]], radius=0.1)
    >>> history = History()  # in memory; History("states") keeps them in a folder
    >>> history.append(0, 0.0, state, report={"loss": [0.5]})
    >>> history.append(1, 0.1, state.replace(means=state.means + np.float32([0, 0, 1])))
    >>> history.indices, history.times
    ([0, 1], array([0. , 0.1]))
    >>> history.stacked("means")[:, 0]  # of every frame
    array([[0., 0., 2.],
           [0., 0., 3.]], dtype=float32)
    >>> history.append(1, 0.2, state)
    Traceback (most recent call last):
    scas4d_core.storage.frame_files.HistoryError: frame 1 comes after frame 1; append frames in rising order
    """

    def __init__(self, directory: Path | str | None = None) -> None:
        super().__init__(None if directory is None else Path(directory))
        self.record_seconds = 0.0
        if self._files is not None:
            self._files.directory.mkdir(parents=True, exist_ok=True)
            if self._files.listed():
                raise HistoryError(
                    f"{self._files.directory.name} already holds a history; open it with History.load or empty it"
                )

    @classmethod
    def open(cls, directory: Path | str) -> History:
        """Opens the history in a directory, or begins one where there is none.

        Raises:
            HistoryError: as ``load``.
        """
        folder = Path(directory)
        folder.mkdir(parents=True, exist_ok=True)
        clear_parts(folder)
        return cls.load(folder) if FrameFiles(folder).exists else cls(folder)

    def save(self, directory: Path | str) -> None:
        """Writes a copy of this history into another directory, one frame at a time."""
        copy = History(directory)
        for index in self.indices:
            copy.append(index, self._times[index], self.gaussians(index), self.report(index))

    def append(self, index: int, time: float, gaussians: Gaussians, report: Mapping[str, Any] | None = None) -> None:
        """Commits the state of one frame with its report; when this returns both are on disk (if there is a directory).

        Args:
            index: frame number, above every index before it.
            time: seconds.
            gaussians: the state; same ids and opacities as in the first frame. The arrays are copied.
            report: made of JSON values (finite numbers, strings, lists, mappings).

        Raises:
            HistoryError: index not above the last, another number of Gaussians, other ids or opacities, or a report
                that is no JSON.
        """
        if index <= self._newest():
            raise HistoryError(f"frame {index} comes after frame {self._newest()}; append frames in rising order")
        began = perf_counter()
        try:
            text = json.dumps(dict(report or {}), allow_nan=False)
        except (TypeError, ValueError) as error:
            raise HistoryError(
                f"frame {index}: the report is no JSON ({error}); give finite numbers, strings, lists, mappings"
            ) from error
        self.record_seconds = perf_counter() - began
        arrays = gaussians.arrays()
        fixed = self._fixed or {name: np.array(arrays[name]) for name in FIXED}
        for name in FIXED:
            if not np.array_equal(arrays[name], fixed[name]):
                raise HistoryError(
                    f"frame {index}: {name} differ from those of the first frame; they are fixed within one history"
                )
        count = len(fixed["ids"])
        for name in PER_FRAME:
            if len(arrays[name]) != count:
                raise HistoryError(f"frame {index}: {name} has {len(arrays[name])} rows; give {count}, one a Gaussian")
        frame = {name: np.array(arrays[name]) for name in PER_FRAME}
        if self._files is not None:
            encoded = text.encode()
            written = _as_written(frame, time, encoded)
            if not self._fixed:
                self._files.write_fixed(fixed, index, written)
            began = perf_counter()
            self._stamps[index] = self._files.write(index, written)
            self.record_seconds += (perf_counter() - began) * len(text) / self._stamps[index][0]
            self._texts[index] = encoded
        else:
            self._stamps[index] = (sum(array.nbytes for array in frame.values()), 0)
        self._fixed = fixed
        self._times[index] = float(time)
        if self._files is None:
            self._reports[index] = json.loads(text)
        self.damaged.pop(index, None)
        self._keep(index, frame)

    def retain(self, *, last: int | None = None, size_bytes: int | None = None) -> list[int]:
        """Deletes the oldest states until the rules hold. Without a rule all stay.

        The first frame stays, because every update needs it, and so do the newest ``NEWEST_KEPT``, from which an
        interrupted scene is resumed, whatever the rule.

        Args:
            last: states to keep besides the first.
            size_bytes: of all frames' files together.

        Returns:
            The indices deleted, rising.

        Raises:
            HistoryError: a rule below 1.
        """
        for name, rule in (("last", last), ("size_bytes", size_bytes)):
            if rule is not None and rule < 1:
                raise HistoryError(f"{name} is {rule}; keep at least 1, or give None to keep all")
        candidates = self.indices[1:-NEWEST_KEPT]
        surplus = 0 if last is None else max(0, len(self) - 1 - last)
        excess = 0 if size_bytes is None else sum(size for size, _ in self._stamps.values()) - size_bytes
        deleted: list[int] = []
        for index in candidates:
            if len(deleted) >= surplus and excess <= 0:
                break
            excess -= self._stamps[index][0]
            if self._files is not None:
                self._files.remove(index)
            self._forget(index)
            deleted.append(index)
        return deleted

    def cut(self, after: int) -> list[int]:
        """Takes back every commit after frame ``after``.

        Returns:
            The indices taken back, damaged ones among them, rising.
        """
        known = sorted(index for index in {*self._times, *self.damaged} if index > after)
        for index in reversed(known):  # the newest first: a cut that is itself cut short leaves a history without gaps
            if self._files is not None:
                self._files.remove(index)
            self._forget(index)
            self.damaged.pop(index, None)
        if known and self._files is not None:
            self._files.sync()
        return known

    @property
    def files(self) -> FrameFiles | None:
        """The files on disk, to mend them (``scas4d_core.remake``); None in memory."""
        return self._files

    def mend_fixed(self) -> dict[str, str]:
        """Writes the files that every frame needs, and their copies, anew where they are damaged.

        Returns:
            The fault of each file that was written, by name.
        """
        if self._files is None or not self._times or not self._fixed:
            return {}
        first = next(iter(self._times))
        mended = self._files.mend_copies(first, self._fixed)
        if self._files.path(first).name in mended:
            self._stamps.update(self._files.stamped((first,)))
        return mended

    def write_again(self, index: int) -> bool:
        """Writes the file of a committed frame anew, the same bits.

        Returns:
            False where the frame is not in memory.
        """
        frame, text = self._frames.get(index), self._texts.get(index)
        if self._files is None or frame is None or text is None or index not in self._times:
            return False
        self._stamps[index] = self._files.write(index, _as_written(frame, self._times[index], text))
        return True

    def replace(self, index: int, time: float, arrays: Mapping[str, Any], report: Mapping[str, Any]) -> None:
        """Writes the state of a frame anew whose file is damaged or gone.

        Args:
            index: of a frame before the newest. time: seconds. arrays: ``PER_FRAME``. report: as for ``append``.

        Raises:
            HistoryError: the frame is not before the newest, or has another number of Gaussians.
        """
        assert self._files is not None
        if index >= self._newest() or len(arrays["means"]) != len(self._fixed["ids"]):
            raise HistoryError(f"frame {index} cannot take the place of one that was committed")
        frame = {name: np.asarray(arrays[name]) for name in PER_FRAME}
        text = json.dumps(dict(report), allow_nan=False).encode()
        self._forget(index)
        self._stamps[index] = self._files.write(index, _as_written(frame, time, text))
        self.damaged.pop(index, None)
        self._times = dict(sorted([*self._times.items(), (index, float(time))]))


def _as_written(frame: Arrays, time: float, report: bytes) -> dict[str, Any]:
    """The arrays of a frame's file."""
    return {**frame, "time": np.float64(time), "report": np.frombuffer(report, np.uint8)}
