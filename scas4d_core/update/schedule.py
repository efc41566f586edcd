"""Schedule of an update, identical on every device: iterations, views, samples and weights.

Layer starts and rate decay depend on the share of completed iterations (``rates``). The stopping rule therefore
determines the total number of iterations before each iteration, and its decisions are recorded with the commit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from scas4d_core.settings import UpdateSettings

NEIGHBOUR_SAMPLE = 4000
"""Number of Gaussians whose neighbours are used in an iteration. It limits the cost in large scenes."""

IMAGE_WEIGHT = 1.0
"""Weight of the image loss, 0.8 L1 + 0.2 (1 − SSIM); other weights (``Weights``) are relative to it."""

SOFT_COLOUR_WEIGHT = 0.01
"""Weight of the mean absolute colour change (Dynamic3DGaussians; the paper does not specify it)."""


def view_order(count: int, iterations: int, rng: np.random.Generator) -> Sequence[int]:
    """Returns the view index of each iteration, from successive random permutations of all views.

    Args:
        count: number of views.
        iterations: number of iterations.
        rng: random generator for the permutations.
    """
    rounds = -(-iterations // count)
    order = np.concatenate([rng.permutation(count) for _ in range(rounds)])[:iterations]
    return [int(index) for index in order]


class ViewPlan:
    """Selects the views of each iteration, in random passes over all views.

    Args:
        count: number of views.
        each: number of views per iteration.
        most: maximum number of iterations, after which the order repeats.
        rng: random generator for the order.
    """

    def __init__(self, count: int, each: int, most: int, rng: np.random.Generator) -> None:
        self._count = count
        self._order = view_order(count, most * each, rng)
        self._each = each
        self._next = 0
        self._left_out: set[int] = set()

    def leave_out(self, views: Iterable[int]) -> None:
        """Excludes views from the following iterations.

        Raises:
            ValueError: if no view remains.
        """
        self._left_out |= set(views)
        if len(self._left_out) == self._count:
            raise ValueError(f"all {self._count} views are excluded; an update needs at least one")

    def take(self) -> list[int]:
        """Returns the view indices of the next iteration."""
        return [self._next_view() for _ in range(self._each)]

    def _next_view(self) -> int:
        while True:
            view = self._order[self._next % len(self._order)]
            self._next += 1
            if view not in self._left_out:
                return view


def plan_samples(count: int, rng: np.random.Generator) -> list[NDArray[np.int64]]:
    """Returns ``count`` indices divided into disjoint random sets of ``NEIGHBOUR_SAMPLE``, one per iteration.

    A remainder of less than a quarter of a set is merged into the previous set. Otherwise, a few Gaussians would carry
    all the weight.
    """
    order = rng.permutation(count)
    size = min(NEIGHBOUR_SAMPLE, max(count, 1))
    cuts = list(range(size, count, size))
    if cuts and 4 * (count - cuts[-1]) < size:
        cuts.pop()
    return [np.sort(part) for part in np.split(order, cuts)]


def mask_weight(settings: UpdateSettings, moving: int, count: int) -> float:
    """Returns the weight of the mask loss for a scene of ``count`` Gaussians, of which ``moving`` may move."""
    return settings.weights.mask if moving < count else settings.weights.mask_alone


COOLING = 0.15
"""Share of the iterations that still follow the decision to stop. Meanwhile, the rates decay, except in layers that are
already frozen."""

LOOK_EVERY = 10
"""Number of iterations between evaluations of the probe views by the stopping rule."""

PROBE = 4
"""Number of iterations after which an update's own speed replaces the speed of previous updates."""

MAX_TIMED = 4000
"""Maximum number of iterations with a time limit."""

UNTIMED = 100
"""Number of planned iterations before the speed is known."""

RATE = 0.3
"""Rate at which the budget's predictions follow new measurements."""
FOR_BIRTHS = 0.4
"""Share of the time budget for fitting added Gaussians, which takes about as long as an update if an object enters."""
AFTER_S = 0.05
"""Initial prediction of the time after the last iteration, in seconds, which is used until a frame has been
measured."""


class Stopping:
    """Rule that ends an update after a number of iterations, at a time limit, or once there is no more progress.

    Args:
        most: maximum number of iterations.
        end: ``clock`` time by which the last iteration must end, in seconds. At least one iteration is run. If None,
            ``most`` iterations are run.
        iteration_seconds: time per iteration in previous updates, in seconds, or None if unknown.
        gain: minimum relative decrease of the error on the probe views per ``LOOK_EVERY`` iterations. With less, the
            update cools down and stops. Probe views are training views, never held-out ones. If 0, there is no early
            stop.
        first: share of the iterations before which there is no early stop, because not all parameters have started.
        clock: function that returns the current time in seconds.

    Attributes:
        planned_so_far: (iteration, total iterations) for each change of plan.

    >>> stopping = Stopping(7)
    >>> stopping.planned(0), stopping.planned(3), stopping.planned_so_far
    (7, 7, [(0, 7)])
    """

    def __init__(
        self,
        most: int = MAX_TIMED,
        *,
        end: float | None = None,
        iteration_seconds: float | None = None,
        gain: float = 0.0,
        first: float = 0.0,
        clock: Callable[[], float] = perf_counter,
    ) -> None:
        self.most, self.end = most, end
        self._each, self._gain, self._first, self._clock = iteration_seconds, gain, first, clock
        self.planned_so_far: list[tuple[int, int]] = []
        self._began = 0.0
        self._error: float | None = None
        self._stop: int | None = None

    def planned(self, done: int) -> int:
        """Returns the total number of iterations of the update, as planned after ``done`` iterations."""
        total = self._total(done)
        if self._stop is not None:
            total = min(total, self._stop)
        if not self.planned_so_far or self.planned_so_far[-1][1] != total:
            self.planned_so_far.append((done, total))
        return total

    def needs_error(self, done: int) -> bool:
        """Returns whether the error on the probe views is needed after ``done`` iterations."""
        return self._gain > 0 and self._stop is None and done % LOOK_EVERY == 0

    def record_error(self, done: int, error: float) -> None:
        """Records the error on the probe views after ``done`` iterations, if ``needs_error`` is true."""
        total = self._total(done)
        if self._error is not None and done >= self._first * total and error > (1 - self._gain) * self._error:
            self._stop = done + max(1, round(COOLING * total))
        self._error = error

    def _total(self, done: int) -> int:
        """Returns the planned total number of iterations without an early stop."""
        if self.end is None:
            return self.most
        now = self._clock()
        if done == 0:
            self._began = now
        each = self._each
        if done >= PROBE or (each is None and done > 0):
            each = (now - self._began) / done
        if each is None:
            return min(self.most, UNTIMED)
        left = int((self.end - now) / max(each, 1e-9))
        return min(self.most, max(1, done + left))


class TimeBudget:
    """A scene's time limit per frame, with a prediction of the time needed after the iterations of an update.

    Decoding happens before the iterations and is measured by the clock. The comparison and checks at the end, the
    checkpoint and the commit happen after the iterations. Their time is predicted from previous frames.

    Args:
        milliseconds: time limit per frame in milliseconds, or None for no limit.

    Attributes:
        milliseconds: time limit per frame in milliseconds, or None for no limit.
        iteration_seconds: predicted time per iteration in seconds, or None if unknown.
        after: predicted time from the last iteration to the end of the commit in seconds, without fits of added
            Gaussians.
        births: whether time is reserved for fits of added Gaussians, because the previous frame had such fits.
    """

    def __init__(self, milliseconds: float | None) -> None:
        self.milliseconds = milliseconds
        self.iteration_seconds: float | None = None
        self.after = AFTER_S
        self.births = False

    def end(self, began: float) -> float | None:
        """Returns the time by which the last iteration of a frame begun at ``began`` must end, or None for no limit."""
        kept = FOR_BIRTHS * self.births * (self.milliseconds or 0.0) / 1000
        return None if (end := self.end_of_births(began)) is None else end - kept

    def end_of_births(self, began: float) -> float | None:
        """Returns the time by which fits of added Gaussians must end, or None for no limit."""
        return None if self.milliseconds is None else began + self.milliseconds / 1000 - self.after

    def record_birth_fits(self, spent: float, postponed: Sequence[str]) -> None:
        """Records the fits of added Gaussians in a frame.

        Args:
            spent: time spent on these fits, in seconds.
            postponed: descriptions of the fits for which there was no time.
        """
        kept = self.births  # time that was reserved but was not sufficient is not reserved again
        self.births = bool(spent or postponed) and not (kept and postponed)

    def record_frame(self, moments: Sequence[float], seconds: Mapping[str, float], commit: float) -> None:
        """Records the time spent on a frame.

        Args:
            moments: end of each iteration of the update; see ``UpdateTrace.iteration_ends``.
            seconds: time spent in each stage of the update, in seconds.
            commit: time spent on checks and writing, in seconds.
        """
        if not moments:
            return
        each = max(0.0, moments[-1] - seconds.get("start", 0.0)) / len(moments)
        after = commit + sum(seconds.get(stage, 0.0) for stage in ("end", "commit"))
        if self.iteration_seconds is None:
            self.iteration_seconds, self.after = each, after
        else:
            self.iteration_seconds = min(
                each, self.iteration_seconds + RATE * (each - self.iteration_seconds)
            )  # a single slow frame has no lasting effect
            self.after += RATE * (after - self.after)
