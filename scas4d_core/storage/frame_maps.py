"""Ordered mappings from frame indices to numbers, with 8 bytes for each index and number.

A scene that runs for a day at 30 fps has 2.6 million frames. Dictionaries would take 150 to 250 bytes for each of them.
"""

from __future__ import annotations

import operator
from array import array
from bisect import bisect_left
from collections.abc import Iterator, MutableMapping
from typing import Any, ClassVar, Generic, SupportsIndex, TypeVar

from scas4d_core.storage.frame_arrays import Stamp

Value = TypeVar("Value")


class FrameMap(MutableMapping[int, Value], Generic[Value]):
    """Mapping from frame indices to rows of numbers, in ascending order of the indices.

    Appending a frame is fast; inserting or deleting one moves the frames after it.

    >>> times = FrameTimes()
    >>> times[3], times[1] = 0.3, 0.1
    >>> dict(times), list(reversed(times)), times.get(2), times.pop(1), len(times)
    ({1: 0.1, 3: 0.3}, [3, 1], None, 0.1, 1)
    """

    codes: ClassVar[str]
    """Type codes (``array.array``) of the numbers in a row."""

    def __init__(self) -> None:
        self._indices = array("q")
        self._columns: list[array[Any]] = [array(code, ()) for code in self.codes]

    def _row(self, place: int) -> Value:
        raise NotImplementedError

    def _numbers(self, value: Value) -> tuple[float, ...]:
        raise NotImplementedError

    def _find(self, index: SupportsIndex) -> tuple[int, bool]:
        """Returns the place of a frame, or where to insert it, and whether it is there."""
        place = bisect_left(self._indices, operator.index(index))
        return place, place < len(self._indices) and self._indices[place] == index

    def __getitem__(self, index: int) -> Value:
        place, known = self._find(index)
        if not known:
            raise KeyError(index)
        return self._row(place)

    def __setitem__(self, index: int, value: Value) -> None:
        place, known = self._find(index)
        if not known:
            self._indices.insert(place, index)
        for column, number in zip(self._columns, self._numbers(value), strict=True):
            if known:
                column[place] = number
            else:
                column.insert(place, number)

    def __delitem__(self, index: int) -> None:
        place, known = self._find(index)
        if not known:
            raise KeyError(index)
        for column in (self._indices, *self._columns):
            del column[place]

    def __contains__(self, index: object) -> bool:
        return isinstance(index, SupportsIndex) and self._find(index)[1]

    def __iter__(self) -> Iterator[int]:
        return iter(self._indices)

    def __reversed__(self) -> Iterator[int]:
        return reversed(self._indices)

    def __len__(self) -> int:
        return len(self._indices)


class FrameTimes(FrameMap[float]):
    """Time of each frame in seconds."""

    codes = "d"

    def _row(self, place: int) -> float:
        return float(self._columns[0][place])

    def _numbers(self, value: float) -> tuple[float, ...]:
        return (value,)

    def column(self) -> array[float]:
        """Returns the times in the order of the frames, without a copy; callers must not modify them."""
        return self._columns[0]


class FrameStamps(FrameMap[Stamp]):
    """Stamp of each frame's file."""

    codes = "qq"

    def _row(self, place: int) -> Stamp:
        return int(self._columns[0][place]), int(self._columns[1][place])

    def _numbers(self, value: Stamp) -> tuple[float, ...]:
        return value
