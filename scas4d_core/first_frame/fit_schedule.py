"""Iteration schedule of frame 0, which can shorten every phase of the fit to meet a time limit.

Learning rates, density control and other events are defined in iterations of the full schedule. If
time is short, each iteration advances the schedule by more than one iteration. The fit thus
completes all of its phases, like a shorter fit, instead of being cut off. The stride is the advance
per iteration. It is computed from the measured pace and updated during the fit. With enough time,
the stride is one, and the result is the same as without a limit.
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
"""Number of iterations below which a fit is not shortened, even if it exceeds the time limit."""
FIRST_TIMED = 10
"""Number of initial iterations that are not timed, because they load kernels and fill caches."""
PLAN_EVERY = 25
"""Number of iterations between updates of the plan. The pace is measured over this interval."""
TIME_TOLERANCE = 1.03
"""Maximum ratio of predicted to remaining time at which the fit is not shortened. Predictions are not
accurate enough for a lower ratio."""
MIN_PLAN_CHANGE = 0.02
"""Relative change in the number of iterations above which a new plan is recorded."""
REPORTED_SHORTFALL = 0.05
"""Fraction of omitted iterations from which the report mentions the omission. Smaller fractions have
less effect than the random seed. The sample at half size (two seeds) reaches 35.33 dB. With 5, 10
and 20% fewer iterations, the sample reaches 35.20, 35.29 and 35.24 dB, and with half the iterations,
35.03 dB. *cloth* at half size (one seed) reaches 28.91 dB. With 5 and 20% fewer iterations, *cloth*
reaches 28.91 and 28.88 dB."""
MIN_COUNT_RATIO = 1.3
"""Minimum ratio of the largest to the smallest number of Gaussians for separating the cost per
Gaussian from the cost of the pixels."""


@dataclass(frozen=True)
class FitProgress:
    """Progress of the fit of frame 0.

    Attributes:
        done: number of completed iterations.
        planned: total number of iterations in the current plan.
        loss: loss of the last iteration.
        seconds: predicted remaining time in seconds, or None if unknown.
    """

    done: int
    planned: int
    loss: float
    seconds: float | None


class FitSchedule:
    """Schedule of a fit, whose stride is adapted to a time limit.

    Args:
        iterations: number of iterations of the full schedule.
        limit: time limit of frame 0.
        expected: function that returns the expected number of Gaussians at a given position in the schedule.

    Attributes:
        done: number of completed iterations.
        at: position in the full schedule, in iterations.
        stride: number of iterations by which the next iteration advances the full schedule.
        fits_again: whether another complete fit must follow within the time limit.
        end: position in the full schedule at which this fit ends.
        shortened: whether any iteration has advanced the schedule by more than one iteration.
        planned: (iteration, total iterations) at each change of plan.
        seconds: predicted remaining time in seconds, or None before the first prediction.

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
        """Starts the next iteration and returns its step."""
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
        """The entries of ``planned`` and, if the fit was shortened, the final number of iterations.

        A fit whose record has a single entry is bit-identical to a fit without a limit.
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
        """Predicts the time in seconds between two points of the full schedule, based on expected Gaussian counts."""
        times, counts = np.array(self._times), np.array(self._counts)
        each, more = times[-1], 0.0
        if counts.max() >= MIN_COUNT_RATIO * counts.min():
            # The cost of an iteration is a constant for its pixels plus a cost per Gaussian. In a linear fit over many
            # iterations, an iteration that was slowed by other processes has little weight.
            more = max(0.0, float(np.polyfit(counts, times, 1)[0]))
            more = min(more, each / counts[-1])
        moments = np.linspace(begin, end, 33)
        growth = [self._expected(float(moment)) - counts[-1] for moment in moments]
        cost = [max(0.0, each + more * gaussians) for gaussians in growth]
        width = (end - begin) / (len(moments) - 1)
        return float(sum(width * (one + two) / 2 for one, two in pairwise(cost)))
