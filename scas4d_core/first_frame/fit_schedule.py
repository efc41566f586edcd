"""Iteration schedule of the fit of frame 0: all iterations of the settings or, with a time limit, fewer in all phases.

Learning rates, density control and other events are defined in iterations of the full schedule. If time is short, one
iteration advances the schedule by more than one. The fit thus completes all of its phases, like a shorter fit, instead
of being cut off. The stride follows from the measured pace and is updated during the fit. With enough time, every
iteration counts as one, and the result is the same as without a limit.
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
"""Minimum number of iterations, even without enough time."""
FIRST_TIMED = 10
"""Number of initial iterations that are not timed, because they load kernels and fill caches."""
PLAN_EVERY = 25
"""Number of iterations between two plans, over which the pace is measured."""
TIME_TOLERANCE = 1.03
"""Ratio of predicted to remaining time up to which nothing is shortened; predictions are not more accurate."""
MIN_PLAN_CHANGE = 0.02
"""Relative change of the number of iterations above which a new plan is recorded."""
REPORTED_SHORTFALL = 0.05
"""Share of missing iterations above which the report mentions them; smaller losses are below the effect of the seed.
The sample at half size, two seeds each: 35.33 dB; with 5, 10 and 20 % fewer 35.20, 35.29 and 35.24; with half of them
35.03. *cloth* at half size, one seed: 28.91 dB; with 5 and 20 % fewer 28.91 and 28.88."""
MIN_COUNT_RATIO = 1.3
"""Minimum ratio of Gaussian counts for separating the cost per Gaussian from that of the pixels."""


@dataclass(frozen=True)
class FitProgress:
    """Progress of the fit.

    Attributes:
        done, planned: completed and total iterations. loss: of the last iteration. seconds: predicted remaining time;
            None if unknown.
    """

    done: int
    planned: int
    loss: float
    seconds: float | None


class FitSchedule:
    """Plans the iterations of a fit within a time limit.

    Args:
        iterations: iterations of the full schedule. limit: time limit of frame 0.
        expected: returns the expected number of Gaussians at a point of the schedule.

    Attributes:
        done: completed iterations. at: position in the full schedule. stride: advance of the next iteration.
        fits_again: whether another complete fit must follow in the same time. end: of this fit, in the full schedule.
        shortened: whether any iteration has advanced by more than one.
        planned: (iteration, total iterations) for each change of plan.

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
        """Starts the next iteration."""
        self._began = self._limit.clock()
        begun, self.at = self.at, min(float(self.iterations), self.at + self.stride)
        self.shortened |= self.stride != 1
        return FitStep(begun, self.at)

    def end_iteration(self, count: int) -> None:
        """Ends an iteration with ``count`` Gaussians, and updates the plan every ``PLAN_EVERY`` iterations."""
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
        """``planned``, and the final number of iterations if the fit was shortened.

        A fit whose record has one entry is bit-identical to a fit without a limit.
        """
        last = (self.done, self.done)
        return self.planned + [last] * (self.shortened and self.planned[-1] != last)

    @property
    def total(self) -> int:
        """Total number of iterations in the current plan."""
        return self.done + ceil((self.iterations - self.at) / self.stride)

    def _plan(self) -> None:
        """Sets the stride from the remaining time, and predicts the remaining seconds."""
        whole = self._seconds(self.at, self.end) + (self._seconds(0.0, self.iterations) if self.fits_again else 0.0)
        over = whole / max(self._limit.seconds_left_for_fit, 1e-3)
        longest = max(1.0, self.iterations / MIN_ITERATIONS)
        self.stride = 1.0 if over <= TIME_TOLERANCE else min(over, longest)
        self.seconds = whole / self.stride
        if abs(self.total - self.planned[-1][1]) > MIN_PLAN_CHANGE * self.planned[-1][1]:
            self.planned.append((self.done, self.total))

    def _seconds(self, begin: float, end: float) -> float:
        """Returns the predicted seconds between two points of the full schedule, with the expected numbers of
        Gaussians.
        """
        times, counts = np.array(self._times), np.array(self._counts)
        each, more = times[-1], 0.0
        if counts.max() >= MIN_COUNT_RATIO * counts.min():
            # The cost of an iteration is a constant for its pixels plus a term per Gaussian. In a linear fit over many
            # iterations, one slowed by other processes has little weight.
            more = max(0.0, float(np.polyfit(counts, times, 1)[0]))
            more = min(more, each / counts[-1])
        moments = np.linspace(begin, end, 33)
        growth = [self._expected(float(moment)) - counts[-1] for moment in moments]
        cost = [max(0.0, each + more * gaussians) for gaussians in growth]
        width = (end - begin) / (len(moments) - 1)
        return float(sum(width * (one + two) / 2 for one, two in pairwise(cost)))
