"""The seconds that frame 0 may take: how many are left for each of its parts, and what they were too few for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf
from time import perf_counter

FEATURES = 0.15
"""Share of the time after which features should be found,"""
MATCHES = 0.2
"""their matches,"""
STEREO = 0.35
"""and stereo, each time that it is tried. Without a limit, all points of basketball, 27 cameras of 640x360, take a
third of its frame 0, those of rigs of four to seven cameras less than a fifth."""
AFTER_S = 2.5
"""Seconds kept for what follows the fit: clusters, neighbours and the commit took 1 to 2 with 50,000 to 90,000
Gaussians."""
AFTER_SHARE = 0.1
"""Of the time, that is kept for it at most."""


class TimeLimit:
    """Bounds the seconds of frame 0; asks for less work before it begins, by the pace that was measured.

    Args:
        seconds: that frame 0 may take from now on; None: as many as it needs. clock: in seconds.

    Attributes:
        shortened: what there was no time for, in words.

    >>> now = [0.0]
    >>> limit = TimeLimit(100.0, clock=lambda: now[0])
    >>> limit.seconds_left(0.5), limit.choose(0.5, [80.0, 40.0, 10.0])
    (50.0, 1)
    >>> now[0] = 30.0
    >>> limit.seconds_left(0.5), limit.choose(0.5, [80.0, 40.0, 10.0]), TimeLimit(None).choose(0.5, [80.0, 40.0])
    (20.0, 2, 0)
    """

    def __init__(self, seconds: float | None, clock: Callable[[], float] = perf_counter) -> None:
        self.seconds, self.clock, self._began = seconds, clock, clock()
        self.shortened: list[str] = []

    @property
    def bounded(self) -> bool:
        """True where there is a limit."""
        return self.seconds is not None

    def seconds_left(self, share: float = 1.0) -> float:
        """Seconds until a share of the time is over, less than 0 once it is; infinity without a limit."""
        return inf if self.seconds is None else self._began + share * self.seconds - self.clock()

    @property
    def seconds_left_for_fit(self) -> float:
        """Seconds until the last iteration has to be over."""
        return inf if self.seconds is None else self.seconds_left() - min(AFTER_S, AFTER_SHARE * self.seconds)

    def choose(self, share: float, costs: Sequence[float]) -> int:
        """Index of the first of several ways that ends before a share of the time is over; else their number.

        Args:
            costs: predicted seconds of each, the best way first.
        """
        left = self.seconds_left(share)
        return next((index for index, cost in enumerate(costs) if cost <= left), len(costs))
