"""Reads the committed states of a scene, Θ_0 … Θ_t, and the lifetimes of Gaussians. Requires only NumPy."""

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
"""Name prefix of the birth arrays that describe newborn Gaussians as they would have been in frame 0 (``roots``)."""
ROOTS = ("means", "factors", "rotations")
"""Names of the ``Gaussians`` arrays that have separate values in the roots."""


class HistoryReader(FramesReader):
    """Reader for committed states, in the memory of this process or in a directory to which another process writes.

    Attributes:
        damaged: maps each unreadable frame to the reason; these frames are not in ``indices``.
    """

    @property
    def newest(self) -> Gaussians:
        """State Θ of the newest frame; see ``gaussians``."""
        return self.gaussians(self.indices[-1])

    def gaussians(self, index: int) -> Gaussians:
        """Returns the state of a committed frame. The arrays belong to the history and must not be modified.

        Raises:
            HistoryError: if the frame was not committed, or its file is damaged.
        """
        self._require(index)
        frame = self._frames.get(index)
        if frame is None:
            frame = self._from_file(index, PER_FRAME, WHOLES)
            self._keep(index, frame)
        else:
            self._frames.move_to_end(index)
        fixed = self.fixed_at(index)
        if len(frame["means"]) != len(fixed["ids"]):
            raise DamagedFrameError(f"frame {index}: expected {len(fixed['ids'])} Gaussians, got {len(frame['means'])}")
        return Gaussians(**frame, **fixed)

    def fixed_at(self, index: int) -> dict[str, NDArray[Any]]:
        """Returns the arguments of ``Gaussians`` that are not stored per frame: opacities, ids and retirements."""
        log = self.log_at(index)
        if not len(log):
            return dict(self._fixed)
        fixed = self._fixed_after(births_in(log))
        return {**fixed, "retired": retired_after(log, fixed["ids"])}

    @property
    def first(self) -> Gaussians:
        """State of the first frame; raises the same errors as ``gaussians``."""
        return self.gaussians(self.indices[0])

    def roots(self, index: int | None = None) -> Gaussians:
        """Returns the first state plus all later Gaussians at their frame-0 positions (``births.extend_roots``).

        Args:
            index: frame up to which births and retirements are included, or None for the newest.

        Raises:
            HistoryError: if the first frame or a birth cannot be read.
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
        """Returns a recomputed state, completed with the Gaussians that were born or revived in its frame.

        Newborn Gaussians are read from their birth file. Revived Gaussians are not stored separately, so they are taken
        from the next readable frame.

        Args:
            index: index of the frame.
            state: recomputed state, possibly without the Gaussians born in the frame.
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
        """[count] ids of all Gaussians so far, in row order."""
        ids: Int = self._fixed_after(births_in(self._events())).get("ids", np.zeros(0, np.int64))
        return ids

    @property
    def count(self) -> int:
        """Number of Gaussians that have been added so far, including retired ones."""
        return len(self.ids)

    @property
    def born_at(self) -> Int:
        """[count] birth frame of the Gaussian in each row; the first frame for initial Gaussians."""
        first = np.full(len(self._fixed.get("ids", ())), next(iter(self._times), -1), np.int64)
        later = [np.full(last - begin + 1, index, np.int64) for index, begin, last in births_in(self._events())]
        return np.concatenate([first, *later])

    @property
    def parents(self) -> Int:
        """[count] row of the parent of the Gaussian in each row; −1 for Gaussians without a parent."""
        none = np.full(len(self._fixed.get("ids", ())), NO_PARENT, np.int64)
        return np.concatenate([none, *(self._born(birth)["parents"] for birth in births_in(self._events()))])

    @property
    def highest_id(self) -> int:
        """Highest id ever assigned to a Gaussian, including Gaussians of truncated frames; −1 if there are none."""
        known = [self.ids, *(arrays["ids"] for arrays in self._births.values())]
        if (files := self._files) is not None:
            for index in set(files.births()) - self._births.keys():
                with suppress(UnreadableFrameError):
                    known.append(files.read_born(index, ("ids",))["ids"])
        return max((int(ids.max()) for ids in known if len(ids)), default=-1)

    def rows_of(self, ids: ArrayLike) -> Int:
        """Returns the row of each id [Q], or −1 if no Gaussian has this id."""
        return rows_among(self.ids, np.asarray(ids, np.int64).reshape(-1))

    def present(self, index: int) -> NDArray[np.bool_]:
        """Returns whether the Gaussian in each row [count] is present in a committed frame: born and not retired.

        Raises:
            HistoryError: if the frame was not committed.
        """
        self._require(index)
        log, ids = self.log_at(index), self.ids
        there = ~retired_after(log, ids)
        there[len(self._fixed_after(births_in(log))["ids"]) :] = False
        return there

    def known_rows(self, ids: ArrayLike) -> Int:
        """Returns the row of each id [Q].

        Raises:
            InputError: if an id is unknown.
        """
        wanted, rows = np.asarray(ids, np.int64).reshape(-1), self.rows_of(ids)
        unknown = wanted[rows < 0]
        if len(unknown):
            raise InputError(
                f"unknown Gaussian ids {unknown[:5].tolist()}",
                f"use ids of the scene's {self.count} Gaussians, such as those in a response",
            )
        return rows

    def lives(self, ids: ArrayLike) -> list[Life]:
        """Returns the lifetimes of the Gaussians with the given ids: frames of birth, retirement and revival.

        Raises:
            InputError: if an id is unknown.
        """
        wanted = self.ids[self.known_rows(ids)].tolist()
        return lives_of(self._events(), wanted, next(iter(self._times), -1))

    def stacked(
        self, name: str, indices: Sequence[int] | None = None, rows: NDArray[np.intp] | None = None
    ) -> NDArray[Any]:
        """Returns one array over several frames, [T, N, ...].

        Values are NaN before a Gaussian's birth, and constant while it is retired. Only this array is read from the
        files, so memory use is limited to the result.

        Args:
            name: name of the array, one of ``PER_FRAME``.
            indices: indices of committed frames, in any order and possibly repeated, or None for all frames.
            rows: rows of Gaussians, of any shape; the result is then [T, *rows.shape, ...].

        Raises:
            HistoryError: if ``name`` is not in ``PER_FRAME``, or a frame was not committed.
        """
        if name not in PER_FRAME:
            raise HistoryError(f"{name!r} is not stored per frame; use one of {', '.join(PER_FRAME)}")
        chosen = self.indices if indices is None else list(indices)
        if not chosen:
            raise HistoryError("indices is empty; pass at least one committed frame")
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
    """Returns the given rows of an array, with NaN for rows beyond its end."""
    if not rows.size or int(rows.max()) < len(array):
        return array[rows]
    taken = np.full((*rows.shape, *array.shape[1:]), np.nan, array.dtype)
    inside = rows < len(array)
    taken[inside] = array[rows[inside]]
    return taken
