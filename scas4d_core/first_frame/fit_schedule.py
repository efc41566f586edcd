"""The schedule of frame 0's fit: every iteration of the settings, or as many as there is time for, all phases shorter.

Rates, density control and all else that happens at its time in the fit are counted in iterations of the full schedule.
Where the time is short, an iteration goes on by more than one of these: the fit ends with all of its phases behind it,
as a shorter fit would, and is not cut off. How much more follows from the pace measured so far, and is found anew
while it goes on. Where there is time enough, each iteration counts one, and nothing differs from a fit without a limit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from math import ceil

import numpy as np

from scas4d_core.first_frame.time_limit import TimeLimit
from scas4d_core.fit.gaussian_fit import FitStep

MIN_ITERATIONS = 500
"""Iterations that are made however little time there is."""
FIRST_TIMED = 10
"""Iterations before those that are timed: they load kernels and fill caches."""
PLAN_EVERY = 25
"""Iterations between two plans; of so many the pace is measured."""
TIME_TOLERANCE = 1.03
"""Predicted time over the time left, up to which nothing is shortened: predictions are not better."""
MIN_PLAN_CHANGE = 0.02
"""Relative change of the number of iterations from which a plan is noted as another one."""
REPORTED_SHORTFALL = 0.05
"""Share of the iterations from which on a report says that they were too few: fewer are lost
in what the seed does. The sample at half size, two seeds each: 35.33 dB, with 5, 10 and 20 % fewer 35.20, 35.29 and
35.24, with half of them 35.03; *cloth* at half size, one seed: 28.91 dB, with 5 and 20 % fewer 28.91 and 28.88."""
MIN_COUNT_RATIO = 1.3
"""Ratio of numbers of Gaussians from which the cost of one can be separated from that of the pixels."""


@dataclass(frozen=True)
class FitProgress:
    """Progress of the fit.

    Attributes:
        done, planned: iterations made, and in all. loss: of the last. seconds: predicted that remain; None: not known.
    """

    done: int
    planned: int
    loss: float
    seconds: float | None


class FitSchedule:
    """Plans the iterations of a fit.

    Args:
        iterations: of the full schedule. limit: of frame 0.
        expected: Gaussians that there will be at a moment of the schedule.

    Attributes:
        done: iterations made. at: how far these are in the full schedule. stride: by how much the next goes on.
        fits_again: whether another whole fit is to follow in the same time. end: of this fit, in the full schedule.
        shortened: whether an iteration has gone on by more than one.
        planned: (iteration, iterations in all) whenever what is planned changed.

    >>> schedule = FitSchedule(4, TimeLimit(None), lambda at: 100.0)
    >>> [(step := schedule.begin_iteration()).begun for _ in range(2)], step.ended, schedule.planned
    ([0.0, 1.0], 2.0, [(0, 4)])
    """

    def __init__(self, iterations: int, limit: TimeLimit, expected: Callable[[float], float]) -> None:
        self.iterations = iterations
        self._limit, self._expected = limit, expected
        self.done, self.at, self.stride = 0, 0.0, 1.0
        self.fits_again = self.shortened = False
        self.planned: list[tuple[int, int]] = [(0, iterations)]
        self.seconds: float | None = None
        self.end = float(iterations)
        self._began = 0.0
        self._times: list[float] = []
        self._counts: list[float] = []
        self._spent: list[float] = []

    def begin_iteration(self) -> FitStep:
        """Begins the next iteration."""
        self._began = self._limit.clock()
        begun, self.at = self.at, min(float(self.iterations), self.at + self.stride)
        self.shortened |= self.stride != 1
        return FitStep(begun, self.at)

    def end_iteration(self, count: int) -> None:
        """Ends an iteration of so many Gaussians, and plans anew from time to time."""
        self.done += 1
        if self.done <= FIRST_TIMED:
            return
        self._spent.append(self._limit.clock() - self._began)
        if len(self._spent) == PLAN_EVERY:
            self._times.append(float(np.mean(self._spent)))
            self._counts.append(float(count))
            self._spent.clear()
            self._plan()

    @property
    def record(self) -> list[tuple[int, int]]:
        """``planned``, and what came of it at last where an iteration went on by more than one.

        A fit whose record has one entry has the bits of a fit without a limit.
        """
        last = (self.done, self.done)
        return self.planned + [last] * (self.shortened and self.planned[-1] != last)

    @property
    def total(self) -> int:
        """Iterations in all, as planned now."""
        return self.done + ceil((self.iterations - self.at) / self.stride)

    def _plan(self) -> None:
        """Sets the stride by the time that is left, and predicts the seconds that remain."""
        whole = self._seconds(self.at, self.end) + (self._seconds(0.0, self.iterations) if self.fits_again else 0.0)
        over = whole / max(self._limit.seconds_left_for_fit, 1e-3)
        longest = max(1.0, self.iterations / MIN_ITERATIONS)
        self.stride = 1.0 if over <= TIME_TOLERANCE else min(over, longest)
        self.seconds = whole / self.stride
        if abs(self.total - self.planned[-1][1]) > MIN_PLAN_CHANGE * self.planned[-1][1]:
            self.planned.append((self.done, self.total))

    def _seconds(self, begin: float, end: float) -> float:
        """Seconds of the iterations between two moments of the full schedule, with as many Gaussians as then."""
        times, counts = np.array(self._times), np.array(self._counts)
        each, more = times[-1], 0.0
        if counts.max() >= MIN_COUNT_RATIO * counts.min():
            # An iteration costs so much for its pixels, and so much for each Gaussian; one that was slow for what
            # else ran beside it weighs little beside the many.
            more = max(0.0, float(np.polyfit(counts, times, 1)[0]))
            more = min(more, each / counts[-1])
        moments = np.linspace(begin, end, 33)
        growth = [self._expected(float(moment)) - counts[-1] for moment in moments]
        cost = [max(0.0, each + more * gaussians) for gaussians in growth]
        width = (end - begin) / (len(moments) - 1)
        return float(sum(width * (one + two) / 2 for one, two in pairwise(cost)))
