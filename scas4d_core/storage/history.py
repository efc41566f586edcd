"""Stores the committed states of a scene, Θ_0 … Θ_t, in memory or in a directory. Requires only NumPy.

On disk (``frame_files``), a history has one file with opacities and ids, written once, and one file per committed
frame with its state, time and report. Frames with newborn Gaussians have a second file. A frame is committed by
renaming its file to its final name. Only one process appends and deletes frames, through a ``History``. Other processes
only read, and see changes after calling ``refresh``.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from time import perf_counter
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.gaussians import FIXED, PER_FRAME, UNBORN, WHOLES, Gaussians
from scas4d_core.storage.births import NO_PARENT, Event, Int, births_in, events_of, retired_after
from scas4d_core.storage.faults import DamagedFrameError, HistoryError, UnreadableFrameError
from scas4d_core.storage.frame_arrays import Arrays, EffectArrays, frame_file_arrays, pack_effects
from scas4d_core.storage.frame_files import FrameFiles
from scas4d_core.storage.frames_reader import FRAMES_KEPT
from scas4d_core.storage.history_reader import ROOT, ROOTS, HistoryReader
from scas4d_core.storage.npz import clear_parts
from scas4d_core.storage.retention import surplus
from scas4d_core.storage.scratch_frames import IN_MEMORY, ScratchFile

__all__ = [
    "FIXED", "FRAMES_KEPT", "NEWEST_KEPT", "PER_FRAME", "DamagedFrameError", "History", "HistoryError",
    "UnreadableFrameError",
]  # fmt: skip

Defer = Callable[[Callable[[], None]], None]
"""Function that receives each function that writes or deletes files of a commit, and calls it now or later."""
NEWEST_KEPT = 2
"""Number of newest states that retention never deletes.

If the newest state is damaged, the scene resumes from the one before it.
"""


def run_now(write: Callable[[], None]) -> None:
    """Calls the function immediately, so that a commit is on disk when it returns."""
    write()


class History(HistoryReader):
    """The committed states of one scene in frame order, for the process that appends to them.

    Args:
        directory: folder of the states, created if missing. If None, recent states are kept in memory and older
            ones in a scratch file (``move_to_scratch``). For a folder with existing states, use ``History.load`` or
            ``History.open``.

    Attributes:
        record_seconds: time in seconds that the last ``append`` spent on the report. It consists of the encoding time
            and a share of the write time proportional to the report's size.

    Raises:
        HistoryError: if ``directory`` already contains states.

    >>> state = Gaussians.of_points([[0, 0, 2]], radius=0.1)
    >>> history = History()  # in memory; History("states") uses a folder
    >>> history.append(0, 0.0, state, report={"loss": [0.5]})
    >>> history.append(1, 0.1, state.replace(means=state.means + np.float32([0, 0, 1])))
    >>> history.indices, history.times
    ([0, 1], array([0. , 0.1]))
    >>> history.stacked("means")[:, 0]  # of every frame
    array([[0., 0., 2.],
           [0., 0., 3.]], dtype=float32)
    >>> history.append(1, 0.2, state)
    Traceback (most recent call last):
    scas4d_core.storage.faults.HistoryError: frame 1 is not after frame 1; append frames in ascending order
    """

    def __init__(self, directory: Path | str | None = None) -> None:
        super().__init__(None if directory is None else Path(directory))
        self.record_seconds = 0.0
        self._scratch: ScratchFile | None = None
        if self._files is not None:
            self._files.directory.mkdir(parents=True, exist_ok=True)
            if self._files.list_stamps():
                raise HistoryError(
                    f"{self._files.directory.name} already contains a history; open it with History.load"
                )

    @classmethod
    def open(cls, directory: Path | str) -> History:
        """Opens the history in a directory, or creates one if there is none.

        Raises:
            HistoryError: see ``load``.
        """
        folder = Path(directory)
        folder.mkdir(parents=True, exist_ok=True)
        history = cls.load(folder) if FrameFiles(folder).exists else cls(folder)
        clear_parts(folder)
        return history

    def save(self, directory: Path | str) -> None:
        """Writes a copy of this history to another directory, one frame at a time."""
        self.copy_frames(self.indices, directory)

    def copy_frames(self, indices: Iterable[int], directory: Path | str | None = None) -> History:
        """Returns a copy of the given frames, in memory or in another directory.

        Ids, births and lifetimes are preserved.

        Args:
            indices: indices of committed frames.
            directory: folder of the copy, created if missing, or None for a copy in memory.
        """
        copy = History(directory)
        for index in sorted(set(indices)):
            arrays, log = self.gaussians(index).arrays(), self.log_at(index)
            frame = {name: _owned(arrays[name]) for name in (*PER_FRAME, *WHOLES) if name in arrays}
            births = {birth[0]: self._born(birth) for birth in births_in(log)}
            text, left = json.dumps(self.report(index)), self._left(index)
            copy._write(index, self._times[index], frame, text, log, births, self._fixed, left)
        return copy

    def append(
        self,
        index: int,
        time: float,
        gaussians: Gaussians,
        report: Mapping[str, Any] | None = None,
        *,
        parents: Int | None = None,
        roots: Gaussians | None = None,
        effects: EffectArrays = MappingProxyType({}),
        defer: Defer = run_now,
    ) -> None:
        """Commits the state and the report of one frame.

        In a history with a directory, they are on disk when this method returns, unless their writing is deferred.

        Args:
            index: frame index, greater than all previous indices.
            time: time of the frame in seconds.
            gaussians: state with the same ids and opacities as the previous frame. Additional rows are newborn
                Gaussians without ids; their ids are assigned here. Writable arrays are copied.
            report: report as JSON values (finite numbers, strings, lists, mappings).
            parents: [B] row of each newborn Gaussian's parent, or None if no newborn Gaussian has a parent.
            roots: roots of all Gaussians (``births.extend_roots``), or None if newborn Gaussians are their own roots.
            effects: arrays that effects need for a cold start, keyed by effect and array name.
            defer: function that is called with a function that writes the files; by default, it calls it immediately.
                The state is in memory when this method returns, but the frame is committed only after the function was
                called, which must happen once, in the order of the frames.

        Raises:
            HistoryError: if the index is not greater than the last index, Gaussians are missing, ids or opacities
                differ, or the report is not valid JSON.
        """
        if index <= self.newest_index:
            raise HistoryError(
                f"frame {index} is not after frame {self.newest_index}; append frames in ascending order"
            )
        began = perf_counter()
        try:
            text = json.dumps(dict(report or {}), allow_nan=False)
        except (TypeError, ValueError) as error:
            raise HistoryError(
                f"frame {index}: the report is not valid JSON ({error}); use finite numbers, strings, lists, mappings"
            ) from error
        self.record_seconds = perf_counter() - began
        arrays, before = gaussians.arrays(), self._events()
        fixed = self._fixed_after(births_in(before)) if self._fixed else {n: _owned(arrays[n]) for n in FIXED}
        count, rows = len(fixed["ids"]), len(arrays["ids"])
        for name in FIXED:
            if not np.array_equal(arrays[name][:count], fixed[name]):
                raise HistoryError(
                    f"frame {index}: {name} differ from those of the first frame; they are fixed within one history"
                )
        if not (arrays["ids"][count:] == UNBORN).all():
            raise HistoryError(f"frame {index}: new Gaussians must have id {UNBORN}, because the commit assigns ids")
        for name in PER_FRAME:
            if len(arrays[name]) != rows:
                raise HistoryError(
                    f"frame {index}: {name} has {len(arrays[name])} rows; expected {rows}, one per Gaussian"
                )
        frame = {name: _owned(arrays[name]) for name in (*PER_FRAME, *WHOLES) if name in arrays}
        births: dict[int, Arrays] = {}
        ids = fixed["ids"]
        if rows > count:
            births[index] = self._birth(index, gaussians.rows(np.arange(count, rows)), parents, roots)
            ids = np.concatenate([ids, births[index]["ids"]])
        retired = np.zeros(rows, np.bool_)
        retired[:count] = retired_after(before, fixed["ids"])
        log = np.concatenate(
            [
                before,
                events_of(index, Event.BORN, np.arange(count, rows), ids),
                events_of(index, Event.RETIRED, np.flatnonzero(gaussians.retired & ~retired), ids),
                events_of(index, Event.REVIVED, np.flatnonzero(retired & ~gaussians.retired), ids),
            ]
        )
        log = log if len(log) > len(before) else before
        self._write(index, time, frame, text, log, births, self._fixed or fixed, pack_effects(effects), defer)

    def _birth(self, index: int, born: Gaussians, parents: Int | None, roots: Gaussians | None) -> Arrays:
        """Returns the arrays to store for the Gaussians born in a frame.

        If a truncated frame is committed again with the same birth, its Gaussians keep their ids. In any other case,
        they get ids that have never been used, not even in a truncated frame.
        """
        count = len(born)
        origin = born if roots is None else roots.rows(np.arange(len(roots) - count, len(roots)))
        parent_rows = np.full(count, NO_PARENT, np.int64) if parents is None else np.array(parents, np.int64)
        arrays = {name: np.array(getattr(born, name)) for name in PER_FRAME}
        arrays |= {name: np.array(born.arrays()[name]) for name in FIXED}
        arrays |= {"parents": parent_rows, **{ROOT + name: np.array(getattr(origin, name)) for name in ROOTS}}
        spent = self._births.get(index)
        if self._files is not None:
            spent = None
            if index in self._files.births():
                with suppress(UnreadableFrameError):
                    spent = self._files.read_born(index)
        same = spent is not None and all(
            name == "ids" or (name in spent and np.array_equal(array, spent[name])) for name, array in arrays.items()
        )
        first = self.highest_id + 1
        return arrays | {"ids": spent["ids"] if same and spent else np.arange(first, first + count, dtype=np.int64)}

    def _write(
        self, index: int, time: float, frame: Arrays, text: str, log: Int, births: Mapping[int, Arrays], fixed: Arrays,
        left: NDArray[np.uint8] | None, defer: Defer = run_now,
    ) -> None:  # fmt: skip
        """Commits a validated frame.

        Args:
            index: index of the frame.
            time: time of the frame in seconds.
            frame: arrays of the state.
            text: report as JSON.
            log: event log up to and including the frame.
            births: arrays of births that may not have been written yet, keyed by frame.
            fixed: fixed arrays of the first frame.
            left: packed effect arrays, or None if there are none.
            defer: see ``append``.
        """
        encoded, files, first = text.encode(), self._files, not self._fixed
        new_births = {born_in: births[born_in] for born_in in births if born_in not in self._births or born_in == index}

        def write_files(files: FrameFiles) -> None:
            written = frame_file_arrays(frame, time, encoded, log, left)
            if first:
                files.write_fixed(fixed, index, written)
            for born_in, arrays in new_births.items():
                files.write_born(born_in, arrays)
            began = perf_counter()
            stamp = self._stamps[index] = files.write(index, written)
            self.record_seconds += (perf_counter() - began) * len(text) / stamp[0]

        if files is not None:
            defer(lambda: write_files(files))
        self._stamps.setdefault(index, (sum(array.nbytes for array in frame.values()), 0))
        self._texts[index] = encoded
        self._births.update(births)
        if left is not None:
            self._packed[index] = left
        self._fixed = fixed
        self._times[index] = float(time)
        self._log = (index, log)
        self.damaged.pop(index, None)
        self._keep(index, frame)
        if self._files is None and len(self._times) > IN_MEMORY:
            self.move_to_scratch(None, IN_MEMORY)

    def retain(self, *, last: int | None = None, size_bytes: int | None = None, defer: Defer = run_now) -> list[int]:
        """Deletes the oldest states until the limits are met. Without a limit, all states are kept.

        The first frame is always kept because every update needs it. The ``NEWEST_KEPT`` newest frames are kept because
        an interrupted scene resumes from them. Frames of a chunk are deleted together, once ``last`` includes none of
        them.

        Args:
            last: number of states to keep in addition to the first, or None for no limit.
            size_bytes: maximum total size of the frame files in bytes, or None for no limit.
            defer: function that is called with a function that deletes the files; see ``append``.

        Returns:
            The indices of the deleted frames, in increasing order.

        Raises:
            HistoryError: if a limit is below 1.
        """
        for name, rule in (("last", last), ("size_bytes", size_bytes)):
            if rule is not None and rule < 1:
                raise HistoryError(f"{name} must be at least 1, or None to keep all frames; got {rule}")
        if last is None and size_bytes is None:
            return []
        with_it = None if self._files is None else self._files.chunk_of
        deleted = surplus(self.indices, lambda index: self._stamps[index][0], NEWEST_KEPT, last, size_bytes, with_it)
        for index in deleted:
            self._forget(index)
        if (files := self._files) is not None and deleted:
            left = frozenset(self._times)
            defer(lambda: files.remove_oldest(deleted, left))
        return deleted

    def move_to_scratch(self, folder: Path | None, keep_newest: int = 1) -> None:
        """Moves all states except the first and the newest from memory to a scratch file, without changing any value.

        If there is no disk space, states stay in memory. The file is deleted together with this history.

        Args:
            folder: folder for the scratch file, or None for the system's temporary folder.
            keep_newest: number of newest states that stay in memory.
        """
        self._scratch = self._scratch or ScratchFile(folder)
        for index in reversed(self.indices[1:-keep_newest] if self._files is None else ()):
            if (moved := self._scratch.store(self._frames[index])) is self._frames[index]:
                break  # this and all earlier states have already been moved, or the disk is full
            self._frames[index] = moved
            self._scratch_reports[index] = self._scratch.store(
                {"report": np.frombuffer(self._texts.pop(index), np.uint8)}
            )

    def truncate(self, after: int) -> list[int]:
        """Removes all commits after frame ``after``.

        Returns:
            The indices of the removed frames, including damaged ones, in increasing order.
        """
        known = sorted(index for index in {*self._times, *self.damaged} if index > after)
        for index in reversed(known):  # newest first, so that an interruption leaves no gaps
            if self._files is not None:
                self._files.remove(index)
            self._forget(index)
            self.damaged.pop(index, None)
        if known and self._files is not None:
            self._files.sync()
        return known

    def repair_fixed(self) -> dict[str, str]:
        """Rewrites damaged files that every frame needs, and damaged copies of these files.

        Returns:
            The problem found in each rewritten file, keyed by file name.
        """
        if self._files is None or not self._times or not self._fixed:
            return {}
        first = next(iter(self._times))
        births = {}
        for birth in births_in(self._events()):
            with suppress(DamagedFrameError):  # neither in memory nor intact on disk
                births[birth[0]] = self._born(birth)
        mended = self._files.repair_copies(first, self._fixed, births)
        if self._files.path(first).name in mended:
            self._stamps.update(self._files.stamps_of((first,)))
        return mended

    def rewrite(self, index: int) -> bool:
        """Rewrites the file of a committed frame with identical content.

        Returns:
            True if the file was rewritten, or False if the frame is not in memory.
        """
        frame, text = self._frames.get(index), self._texts.get(index)
        if self._files is None or frame is None or text is None or index not in self._times:
            return False
        self._stamps[index] = self._files.write(
            index, frame_file_arrays(frame, self._times[index], text, self.log_at(index), self._left(index))
        )
        return True

    def replace(
        self, index: int, time: float, arrays: Mapping[str, Any], report: Mapping[str, Any],
        effects: EffectArrays = MappingProxyType({}),
    ) -> None:  # fmt: skip
        """Rewrites the state of a frame whose file is damaged or missing.

        Args:
            index: index of a frame before the newest one.
            time: time of the frame in seconds.
            arrays: all arrays named in ``PER_FRAME``, and any of those named in ``WHOLES``.
            report: report as JSON values; see ``append``.
            effects: arrays that effects need for a cold start; see ``append``.

        Raises:
            HistoryError: if the frame is not before the newest one, or the number of Gaussians differs.
        """
        assert self._files is not None
        log = self.log_at(index)
        if index >= self.newest_index or len(arrays["means"]) != len(self._fixed_after(births_in(log))["ids"]):
            raise HistoryError(
                f"frame {index} cannot be replaced: it is the newest frame, or the number of rows differs"
            )
        frame = {name: np.asarray(arrays[name]) for name in (*PER_FRAME, *WHOLES) if name in arrays}
        text = json.dumps(dict(report), allow_nan=False).encode()
        self._forget(index)
        self._stamps[index] = self._files.write(index, frame_file_arrays(frame, time, text, log, pack_effects(effects)))
        self.damaged.pop(index, None)
        self._times[index] = float(time)


def _owned(array: NDArray[Any]) -> NDArray[Any]:
    """Returns the array if it owns its memory and is read-only, otherwise a copy."""
    return array if array.base is None and not array.flags.writeable else np.array(array)
