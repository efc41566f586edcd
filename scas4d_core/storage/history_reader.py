"""Reads the committed states of a scene: Θ_0 … Θ_t, and which Gaussians there were when. Numpy only."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scas4d_core.errors import InputError
from scas4d_core.gaussians import FIXED, PER_FRAME, WHOLES, Gaussians
from scas4d_core.storage.births import (
    NO_PARENT,
    Int,
    Life,
    births_in,
    lives_of,
    retired_after,
    revived_in,
    rows_among,
)
from scas4d_core.storage.faults import DamagedFrameError, HistoryError, UnreadableFrameError
from scas4d_core.storage.frames_reader import FramesReader

ROOT = "root."
"""Before the names of the arrays of a birth that say where the born would have been in the first frame (``roots``)."""
ROOTS = ("means", "factors", "rotations")
"""Arrays of ``Gaussians`` that the roots of the born have of their own."""


class HistoryReader(FramesReader):
    """Reads committed states, from the memory of this process or from a directory that another process writes.

    Attributes:
        damaged: frames whose file cannot be read, with the reason; they are not among ``indices``.
    """

    @property
    def newest(self) -> Gaussians:
        """Θ of the newest frame; see ``gaussians``."""
        return self.gaussians(self.indices[-1])

    def gaussians(self, index: int) -> Gaussians:
        """The state of one committed frame; the arrays are the history's own and must not be written to.

        Raises:
            HistoryError: the frame was not committed, or its file is damaged.
        """
        self._require(index)
        frame = self._frames.get(index)
        if frame is None:
            frame = self._from_file(index, PER_FRAME, WHOLES)
            self._keep(index, frame)
        else:
            self._frames.move_to_end(index)
        log = self.log_at(index)
        if not len(log):
            return Gaussians(**frame, **self._fixed)
        fixed = self._fixed_after(births_in(log))
        if len(frame["means"]) != len(fixed["ids"]):
            raise DamagedFrameError(f"frame {index}: {len(frame['means'])} Gaussians, its log says {len(fixed['ids'])}")
        return Gaussians(**frame, **fixed, retired=retired_after(log, fixed["ids"]))

    @property
    def first(self) -> Gaussians:
        """The state of the first frame; it raises as ``gaussians`` does."""
        return self.gaussians(self.indices[0])

    def roots(self, index: int | None = None) -> Gaussians:
        """The first frame, with the Gaussians born since where they would have been in it (``births.extend_roots``).

        Args:
            index: of a frame: those born by then, and retired as then; None: the newest.

        Raises:
            HistoryError: the first frame cannot be read, or what is kept of a birth.
        """
        log = self._events() if index is None else self.log_at(index)
        if not len(log):
            return self.first
        roots, births = self.gaussians(self.indices[0]), births_in(log)
        for birth in births:
            born = self._born(birth)
            given = {name: born[name] for name in (*FIXED, *PER_FRAME)}
            roots = roots.concatenate(Gaussians(**given | {name: born[ROOT + name] for name in ROOTS}))
        fixed = self._fixed_after(births)
        return roots.replace(ids=fixed["ids"], retired=retired_after(log, fixed["ids"]))

    def complete_state(self, index: int, state: Gaussians) -> Gaussians:
        """A state that was made again for a frame, with what was born in it, as it was then, and what came back in it.

        Where that came back is not kept apart: it is shown as in the next frame that can be read.
        """
        log = self.log_at(index)
        for birth in births_in(log):
            born = self._born(birth)
            if self.rows_of(birth[1:2])[0] >= len(state):
                state = state.concatenate(Gaussians(**{name: born[name] for name in (*FIXED, *PER_FRAME)}))
        later = next((one for one in self._times if one > index), None)
        back = revived_in(log, index, state.ids)
        if later is None or not len(back):
            return state
        with suppress(HistoryError):
            there = self.gaussians(later)
            back = back[there.present[back]]
            arrays = {name: np.array(getattr(state, name)) for name in PER_FRAME}
            for name, array in arrays.items():
                array[back] = getattr(there, name)[back]
            state = state.replace(**arrays)
        return state

    @property
    def ids(self) -> Int:
        """[count] ids of all Gaussians that there have been, by row."""
        ids: Int = self._fixed_after(births_in(self._events())).get("ids", np.zeros(0, np.int64))
        return ids

    @property
    def count(self) -> int:
        """Gaussians that there have been."""
        return len(self.ids)

    @property
    def born_at(self) -> Int:
        """[count] frame in which each Gaussian, by row, was born; the first one, for those that it began with."""
        first = np.full(len(self._fixed.get("ids", ())), next(iter(self._times), -1), np.int64)
        later = [np.full(last - begin + 1, index, np.int64) for index, begin, last in births_in(self._events())]
        return np.concatenate([first, *later])

    @property
    def parents(self) -> Int:
        """[count] row of the parent that each Gaussian, by row, joined at its birth; −1 for one without."""
        none = np.full(len(self._fixed.get("ids", ())), NO_PARENT, np.int64)
        return np.concatenate([none, *(self._born(birth)["parents"] for birth in births_in(self._events()))])

    @property
    def highest_id(self) -> int:
        """The highest id that any Gaussian has or had, also in frames that were taken back; −1 without one."""
        known = [self.ids, *(arrays["ids"] for arrays in self._births.values())]
        if (files := self._files) is not None:
            for index in set(files.births()) - self._births.keys():
                with suppress(UnreadableFrameError):
                    known.append(files.read_born(index, ("ids",))["ids"])
        return max((int(ids.max()) for ids in known if len(ids)), default=-1)

    def rows_of(self, ids: ArrayLike) -> Int:
        """[Q] rows of ids; −1 for an id that no Gaussian has."""
        return rows_among(self.ids, np.asarray(ids, np.int64).reshape(-1))

    def present(self, index: int) -> NDArray[np.bool_]:
        """[count] bool, by row: the Gaussians that are there in a committed frame, born before or in it, not retired.

        Raises:
            HistoryError: the frame was not committed.
        """
        self._require(index)
        log, ids = self.log_at(index), self.ids
        there = ~retired_after(log, ids)
        there[len(self._fixed_after(births_in(log))["ids"]) :] = False
        return there

    def known_rows(self, ids: ArrayLike) -> Int:
        """[Q] rows of ids.

        Raises:
            InputError: an id that no Gaussian has.
        """
        wanted, rows = np.asarray(ids, np.int64).reshape(-1), self.rows_of(ids)
        unknown = wanted[rows < 0]
        if len(unknown):
            raise InputError(
                f"ids {unknown[:5].tolist()} are not Gaussians of this scene",
                f"take ids from an answer, or of its {self.count} Gaussians",
            )
        return rows

    def lives(self, ids: ArrayLike) -> list[Life]:
        """The frames in which Gaussians were born, retired and revived, by id.

        Raises:
            InputError: an id that no Gaussian has.
        """
        wanted = self.ids[self.known_rows(ids)].tolist()
        return lives_of(self._events(), wanted, next(iter(self._times), -1))

    def stacked(
        self, name: str, indices: Sequence[int] | None = None, rows: NDArray[np.intp] | None = None
    ) -> NDArray[Any]:
        """One array of several frames, [T, N, ...], in the order of ``indices`` (default: every frame).

        Where a Gaussian is not born yet it is NaN; where one is retired, as it was when it was there last. Only that
        array is read from the files: a long history needs no more memory than the answer.

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
                array = _taken(array, rows)
            if result is None:
                result = np.empty((len(chosen), *array.shape), dtype=array.dtype)
            if len(array) > result.shape[1]:
                more = np.full((len(chosen), len(array) - result.shape[1], *array.shape[1:]), np.nan, array.dtype)
                result = np.concatenate([result, more], axis=1)
            result[row, : len(array)], result[row, len(array) :] = array, np.nan
        assert result is not None
        return result


def _taken(array: NDArray[Any], rows: NDArray[np.intp]) -> NDArray[Any]:
    """Rows of an array, any shape; NaN for those that it does not have."""
    if not rows.size or int(rows.max()) < len(array):
        return array[rows]
    taken = np.full((*rows.shape, *array.shape[1:]), np.nan, array.dtype)
    inside = rows < len(array)
    taken[inside] = array[rows[inside]]
    return taken
