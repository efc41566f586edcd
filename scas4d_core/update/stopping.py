"""How many iterations an update takes: a number, as many as fit into a time, or fewer once the pictures are met.

The schedule of an update (when layers begin, how the rates fall) follows the share of the iterations that is done, so a
pace says before each iteration how many there will be in all. What it said is recorded with the commit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter
from typing import Protocol

COOLING = 0.15
"""Share of the iterations that follows the decision to stop: the rates fall to their end first."""

LOOK_EVERY = 10
"""Iterations between two looks at the witnesses, where a pace looks."""

PROBE = 4
"""Iterations after which an update's own speed is worth more than what the updates before took."""

MOST_TIMED = 4000
"""Iterations that an update by the clock has at most."""


class Pace(Protocol):
    """Decides how long one update goes on.

    Attributes:
        most: iterations there can be at most.
        told: (iteration, planned) whenever what is planned changed.
    """

    told: list[tuple[int, int]]

    @property
    def most(self) -> int:
        """See above."""

    def planned(self, done: int) -> int:
        """Iterations in all, as seen before iteration ``done``, counted from 0; the update ends at ``done`` or less."""

    def looks(self, done: int) -> bool:
        """Whether it wants to know the witnesses' error after ``done`` iterations."""

    def saw(self, done: int, error: float) -> None:
        """The witnesses' error after ``done`` iterations, where ``looks`` said so."""


class Blind:
    """A pace that does not look."""

    def looks(self, done: int) -> bool:
        """See ``Pace.looks``."""
        return False

    def saw(self, done: int, error: float) -> None:
        """See ``Pace.saw``."""


@dataclass
class Counted(Blind):
    """So many iterations."""

    most: int
    told: list[tuple[int, int]] = field(default_factory=list)

    def planned(self, done: int) -> int:
        """See ``Pace.planned``."""
        return _tell(self, done, self.most)


@dataclass
class Timed(Blind):
    """As many iterations as fit before a moment of ``clock``; at least one.

    Attributes:
        end: the moment by which the last iteration has to be over, seconds.
        each: seconds of an iteration in the updates before, or None where there was none.
    """

    end: float
    each: float | None
    most: int = MOST_TIMED
    clock: Callable[[], float] = perf_counter
    told: list[tuple[int, int]] = field(default_factory=list)
    _began: float = 0.0

    def planned(self, done: int) -> int:
        """See ``Pace.planned``."""
        now = self.clock()
        if done == 0:
            self._began = now
        each = self.each
        if done >= PROBE or (each is None and done > 0):
            each = (now - self._began) / done
        if each is None:
            return _tell(self, done, min(self.most, 100))
        left = int((self.end - now) / max(each, 1e-9))
        return _tell(self, done, min(self.most, max(1, done + left)))


@dataclass
class UntilMet:
    """Fewer than ``pace`` plans, once going on brings next to nothing.

    Every ``LOOK_EVERY`` iterations the witnesses (``witness``: training views, never those held out) are looked at.
    Where their error fell by less than a share ``gain`` since the look before, the update cools down and ends.

    Attributes:
        first: share of the iterations before which it does not end: what begins late has to have begun.
    """

    pace: Pace
    gain: float
    first: float = 0.0
    told: list[tuple[int, int]] = field(default_factory=list)
    _error: float | None = None
    _end: int | None = None

    @property
    def most(self) -> int:
        """See ``Pace``."""
        return self.pace.most

    def looks(self, done: int) -> bool:
        """See ``Pace.looks``."""
        return self._end is None and done % LOOK_EVERY == 0

    def saw(self, done: int, error: float) -> None:
        """See ``Pace.saw``."""
        total = self.pace.planned(done)
        if self._error is not None and done >= self.first * total and error > (1 - self.gain) * self._error:
            self._end = done + max(1, round(COOLING * total))
        self._error = error

    def planned(self, done: int) -> int:
        """See ``Pace.planned``."""
        total = self.pace.planned(done)
        return _tell(self, done, total if self._end is None else min(total, self._end))


def by_clock(pace: Pace | None) -> bool:
    """Whether a pace looks at a clock, itself or the one that it shortens."""
    return by_clock(pace.pace) if isinstance(pace, UntilMet) else isinstance(pace, Timed)


def _tell(pace: Pace, done: int, total: int) -> int:
    if not pace.told or pace.told[-1][1] != total:
        pace.told.append((done, total))
    return total
