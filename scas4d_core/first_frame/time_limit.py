"""The time limit of frame 0: remaining seconds for each step, and steps that had too little time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf
from time import perf_counter

FEATURES = 0.15
"""Share of the time by which features should be found."""
MATCHES = 0.2
"""Share of the time by which features should be matched."""
STEREO = 0.35
"""Share of the time by which stereo should end, each time that it is tried. Without a limit, the initial points of
basketball (27 cameras at 640x360) take a third of its frame 0. Those of rigs of four to seven cameras take less than a
fifth."""
AFTER_S = 2.5
"""Seconds reserved for the steps after the fit: clusters, neighbours and the commit took 1 to 2 with 50,000 to 90,000
Gaussians."""
AFTER_SHARE = 0.1
"""Maximum share of the time that is reserved for them."""


class TimeLimit:
    """Limits the duration of frame 0 by selecting cheaper alternatives according to the measured pace.

    Args:
        seconds: limit of frame 0 from now on; None for no limit. clock: returns seconds.

    Attributes:
        shortened: steps that had too little time, in words.

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
        """True if there is a limit."""
        return self.seconds is not None

    def seconds_left(self, share: float = 1.0) -> float:
        """Returns the seconds until a share of the time has passed, negative afterwards; infinity without a limit."""
        return inf if self.seconds is None else self._began + share * self.seconds - self.clock()

    @property
    def seconds_left_for_fit(self) -> float:
        """Seconds until the last iteration must end."""
        return inf if self.seconds is None else self.seconds_left() - min(AFTER_S, AFTER_SHARE * self.seconds)

    def choose(self, share: float, costs: Sequence[float]) -> int:
        """Returns the index of the first alternative that ends before a share of the time has passed; if none, their
        number.

        Args:
            costs: predicted seconds of each alternative, the best first.
        """
        left = self.seconds_left(share)
        return next((index for index, cost in enumerate(costs) if cost <= left), len(costs))
