"""Θ_0 … Θ_t: the committed states of a scene, in memory or in a directory. Numpy only.

On disk (``frame_files``) a history is one file with opacities and ids, written once, and one a committed frame, which
holds its state, its time and its report; its rename to its final name is the commit. One process appends and deletes;
others read, and see what it did with ``refresh``.
"""

from __future__ import annotations

import json
from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.gaussians import Gaussians
from scas4d_core.storage.frame_files import (
    Arrays,
    DamagedFrameError,
    FrameFiles,
    HistoryError,
    Stamp,
    UnreadableFrameError,
)
from scas4d_core.storage.npz import clear_parts

__all__ = [
    "FIXED", "FRAMES_KEPT", "NEWEST_KEPT", "PER_FRAME", "DamagedFrameError", "History", "HistoryError",
    "UnreadableFrameError",
]  # fmt: skip

PER_FRAME = ("means", "rotations", "factors", "colours", "foreground")
"""Arrays of ``Gaussians`` that may differ from frame to frame."""
FIXED = ("opacities", "ids")
"""Arrays of ``Gaussians`` that a scene keeps after frame 0."""
FRAMES_KEPT = 4
"""Frames of a history on disk that stay in memory: the newest, and the last ones asked for."""
NEWEST_KEPT = 2
"""Newest states that retention never deletes: should the last be damaged, the one before it is gone on from."""


class History:
    """The committed states of one scene, in the order of their indices.

    Args:
        directory: where the frames are kept, made when missing; without it they stay in memory. A directory that
            already holds frames is opened with ``History.load`` or ``History.open``.

    Attributes:
        damaged: frames whose file cannot be read, with the reason; they are not among ``indices``.
        record_seconds: that the last ``append`` spent on the report: encoding it, and its share of writing, by bytes.

    Raises:
        HistoryError: ``directory`` already holds frames.
    """

    def __init__(self, directory: Path | str | None = None) -> None:
        self._files = None if directory is None else FrameFiles(Path(directory))
        self.damaged: dict[int, str] = {}
        self.record_seconds = 0.0
        self._fixed: Arrays = {}
        self._times: dict[int, float] = {}
        self._reports: dict[int, dict[str, Any]] = {}
        self._stamps: dict[int, Stamp] = {}
        self._texts: dict[int, bytes] = {}
        """Reports on disk of the frames that are in memory."""
        self._frames: OrderedDict[int, Arrays] = OrderedDict()
        if self._files is not None:
            self._files.directory.mkdir(parents=True, exist_ok=True)
            if self._files.listed():
                raise HistoryError(
                    f"{self._files.directory.name} already holds a history; open it with History.load or empty it"
                )

    @classmethod
    def load(cls, directory: Path | str, only: Iterable[int] | None = None) -> History:
        """Opens the history in a directory; ``append`` goes on behind its last frame.

        A frame that cannot be read is left out and named in ``damaged``.

        Args:
            directory: of the history.
            only: frames to know of, for who reads those alone; every file of the directory is looked at without.

        Raises:
            HistoryError: no history there, or the file that all frames need is damaged.
        """
        files = FrameFiles(Path(directory))
        if not files.there:
            raise HistoryError(f"{files.directory.name} holds no history: {files.fixed.name} is missing")
        history = cls()
        history._files = files
        history.refresh(only)
        if history._stamps:
            history._fixed = files.read_fixed(FIXED)
        return history

    @classmethod
    def open(cls, directory: Path | str) -> History:
        """The history in a directory, or a new one where there is none; for the process that appends.

        Raises:
            HistoryError: as ``load``.
        """
        folder = Path(directory)
        folder.mkdir(parents=True, exist_ok=True)
        clear_parts(folder)
        return cls.load(folder) if FrameFiles(folder).there else cls(folder)

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
            report: how the state came about, as JSON (finite numbers, strings, lists, mappings); see ``report``.

        Raises:
            HistoryError: index not above the last, another number of Gaussians, other ids or opacities, or a report
                that is no JSON.
        """
        if index <= self._newest():
            raise HistoryError(f"frame {index} comes after frame {self._newest()}; append frames in rising order")
        began = perf_counter()
        try:
            said = json.dumps(dict(report or {}), allow_nan=False)
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
            text = said.encode()
            written = _as_written(frame, time, text)
            if not self._fixed:
                self._files.write_fixed(fixed, index, written)
            began = perf_counter()
            self._stamps[index] = self._files.write(index, written)
            self.record_seconds += (perf_counter() - began) * len(said) / self._stamps[index][0]
            self._texts[index] = text
        else:
            self._stamps[index] = (sum(array.nbytes for array in frame.values()), 0)
        self._fixed = fixed
        self._times[index] = float(time)
        if self._files is None:
            self._reports[index] = json.loads(said)
        self.damaged.pop(index, None)
        self._keep(index, frame)

    def refresh(self, only: Iterable[int] | None = None) -> tuple[list[int], list[int]]:
        """Picks up what the process that writes this directory has done since; frames that are known stay unopened.

        Args:
            only: frames that may have changed, where that is known: a directory of a day takes a while to look through.

        Returns:
            The indices that are new (or written anew), and those that are gone.
        """
        if self._files is None:
            return [], []
        looked_at = {*self._times, *self.damaged} if only is None else set(only)
        listed = self._files.listed() if only is None else self._files.stamped(looked_at)
        gone = sorted(index for index in looked_at if index in self._times and index not in listed)
        changed = [index for index, stamp in listed.items() if self._stamps.get(index) != stamp]
        for index in [*gone, *changed]:
            self._forget(index)
        for index in looked_at - listed.keys():
            self.damaged.pop(index, None)
        newest = self._newest()
        added = []
        for index in changed:
            try:
                self._times[index] = self._files.time(index)
            except FileNotFoundError:  # deleted since it was listed
                continue
            except ValueError as error:
                self.damaged[index] = str(error)
            else:
                self.damaged.pop(index, None)
                added.append(index)
            self._stamps[index] = listed[index]
        if added and added[0] < newest:
            self._times = dict(sorted(self._times.items()))
        if added and not self._fixed:
            self._fixed = self._files.read_fixed(FIXED)
        return added, gone

    def retain(self, *, last: int | None = None, size_bytes: int | None = None) -> list[int]:
        """Deletes the oldest states until the rules hold; for the process that appends. No rule keeps all.

        The first frame stays, because every update needs it, and so do the newest ``NEWEST_KEPT``, from which an
        interrupted scene goes on, whatever the rule.

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
        """Takes back every commit after frame ``after``; for the process that appends.

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
        """The files on disk, for who mends them (``scas4d_core.remake``); None in memory."""
        return self._files

    def take_faults(self) -> dict[str, str]:
        """Files that were found damaged or gone since this was asked last, by name with the reason."""
        if self._files is None:
            return {}
        faults, self._files.faults = self._files.faults, {}
        return faults

    def mend_fixed(self) -> dict[str, str]:
        """Writes anew what every frame needs, and its copy, where they are damaged; for the process that appends.

        Returns:
            What was wrong with each file that was written, by name.
        """
        if self._files is None or not self._times or not self._fixed:
            return {}
        first = next(iter(self._times))
        mended = self._files.mend_copies(first, self._fixed)
        if self._files.path(first).name in mended:
            self._stamps.update(self._files.stamped((first,)))
        return mended

    def write_again(self, index: int) -> bool:
        """Writes the file of a committed frame anew, the same bits; for the process that appends.

        Returns:
            False where the frame is not in memory.
        """
        frame, text = self._frames.get(index), self._texts.get(index)
        if self._files is None or frame is None or text is None or index not in self._times:
            return False
        self._stamps[index] = self._files.write(index, _as_written(frame, self._times[index], text))
        return True

    def replace(self, index: int, time: float, arrays: Mapping[str, Any], report: Mapping[str, Any]) -> None:
        """Writes the state of a frame whose file is damaged or gone anew; for the process that appends.

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

    @property
    def directory(self) -> Path | None:
        """Where the frames are kept; None in memory."""
        return None if self._files is None else self._files.directory

    def __len__(self) -> int:
        return len(self._times)

    def __contains__(self, index: object) -> bool:
        return index in self._times

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

    def report(self, index: int) -> dict[str, Any]:
        """What was committed with the state of a frame about how it came about; empty where nothing was.

        Raises:
            HistoryError: the frame was not committed, or its file is damaged.
        """
        self._require(index)
        if self._files is None:
            return dict(self._reports[index])
        text = self._texts.get(index)
        if text is None:
            text = self._from_file(index, ("report",))["report"].tobytes()
        try:
            report: dict[str, Any] = json.loads(text)
        except ValueError as error:
            raise HistoryError(f"{self._files.path(index).name}: its report is no JSON ({error})") from error
        if index in self._frames:
            self._texts[index] = text
        return report

    def gaussians(self, index: int) -> Gaussians:
        """The state of one committed frame; the arrays are the history's own and must not be written to.

        Raises:
            HistoryError: the frame was not committed, or its file is damaged.
        """
        self._require(index)
        frame = self._frames.get(index)
        if frame is None:
            frame = self._from_file(index, PER_FRAME)
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
            array = frame[name] if frame is not None else self._from_file(index, (name,))[name]
            if rows is not None:
                array = array[rows]
            if result is None:
                result = np.empty((len(chosen), *array.shape), dtype=array.dtype)
            result[row] = array
        assert result is not None
        return result

    def _require(self, index: int) -> None:
        if index in self._times:
            return
        if index in self.damaged:
            raise DamagedFrameError(f"frame {index} cannot be read: {self.damaged[index]}")
        held = f"{next(iter(self._times))} to {self._newest()}" if self._times else "none yet"
        raise UnreadableFrameError(f"frame {index} is not in the history; committed frames: {held}")

    def _newest(self) -> int:
        """Index of the last frame, -1 without one; ``indices`` copies all of them."""
        return next(reversed(self._times), -1)

    def _from_file(self, index: int, names: Sequence[str]) -> Arrays:
        assert self._files is not None
        try:
            return self._files.read(index, names)
        except FileNotFoundError:
            self._forget(index)  # the process that appends has deleted it, or somebody else has
            self._files.faults[self._files.path(index).name] = f"{self._files.path(index).name} is gone"
            self._require(index)
            raise
        except UnreadableFrameError as error:
            stamp = self._stamps.get(index)
            self._forget(index)
            self.damaged[index] = str(error)
            if stamp is not None:  # until another file is there
                self._stamps[index] = stamp
            raise DamagedFrameError(str(error)) from error

    def _forget(self, index: int) -> None:
        self._times.pop(index, None)
        self._reports.pop(index, None)
        self._stamps.pop(index, None)
        self._texts.pop(index, None)
        self._frames.pop(index, None)

    def _keep(self, index: int, frame: Arrays) -> None:
        self._frames[index] = frame
        if self._files is not None:
            newest = self._newest()
            for old in [i for i in self._frames if i != newest][: max(0, len(self._frames) - FRAMES_KEPT)]:
                del self._frames[old]
                self._texts.pop(old, None)


def _as_written(frame: Arrays, time: float, report: bytes) -> dict[str, Any]:
    return {**frame, "time": np.float64(time), "report": np.frombuffer(report, np.uint8)}
