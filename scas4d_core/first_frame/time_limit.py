"""Time limit of frame 0, and the steps that were shortened to meet the limit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf
from time import perf_counter

FEATURES = 0.15
"""Fraction of the time limit by which feature extraction should be finished."""
MATCHES = 0.2
"""Fraction of the time limit by which feature matching should be finished."""
STEREO = 0.35
"""Fraction of the time limit by which every run of stereo should end. Without a limit, computing the
initial points takes a third of the time of frame 0 on basketball (27 cameras at 640x360). On rigs of
four to seven cameras, the points take less than a fifth."""
AFTER_S = 2.5
"""Seconds reserved for the steps after the fit. Clustering, the neighbour graph and the commit took 1 to
2 seconds for 50,000 to 90,000 Gaussians."""
AFTER_SHARE = 0.1
"""Maximum fraction of the time limit reserved for the steps after the fit."""


class TimeLimit:
    """Time limit of frame 0, with a choice between alternatives of different duration.

    Args:
        seconds: time limit of frame 0 in seconds, counted from now, or None for no limit.
        clock: function that returns the current time in seconds.

    Attributes:
        shortened: descriptions of the steps that were shortened or skipped for lack of time.

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
        """Whether there is a limit."""
        return self.seconds is not None

    def seconds_left(self, share: float = 1.0) -> float:
        """Returns the seconds until the fraction ``share`` of the time limit has passed.

        After that moment, the value is negative. Without a limit, the value is infinite.
        """
        return inf if self.seconds is None else self._began + share * self.seconds - self.clock()

    @property
    def seconds_left_for_fit(self) -> float:
        """Seconds until the last iteration of the fit must end, or infinity without a limit."""
        return inf if self.seconds is None else self.seconds_left() - min(AFTER_S, AFTER_SHARE * self.seconds)

    def choose(self, share: float, costs: Sequence[float]) -> int:
        """Returns the index of the first alternative that is fast enough.

        If no alternative is fast enough, the number of alternatives is returned.

        Args:
            share: fraction of the time limit by which the alternative must end.
            costs: predicted duration of each alternative in seconds, best alternative first.
        """
        left = self.seconds_left(share)
        return next((index for index, cost in enumerate(costs) if cost <= left), len(costs))
