"""Schedule of an update, the same on every device: iterations, views, samples and weights.

Layers begin, and rates fall, by the share of the iterations that is done (``rates``), so the stopping rule says before
each iteration how many there will be in all. What it said is recorded with the commit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from scas4d_core.settings import UpdateSettings

NEIGHBOUR_SAMPLE = 4000
"""Gaussians whose neighbours are looked at an iteration: what the neighbour terms cost does not grow with the scene."""

IMAGE_WEIGHT = 1.0
"""Weight of the image loss, 0.8 L1 + 0.2 (1 − SSIM); those of the other terms (``Weights``) are relative to it."""

SOFT_COLOUR_WEIGHT = 0.01
"""Weight of the mean absolute change of the colours (Dynamic3DGaussians; the paper does not give it)."""


def view_order(count: int, iterations: int, rng: np.random.Generator) -> Sequence[int]:
    """The view that each iteration trains: a new random order whenever all have been used."""
    rounds = -(-iterations // count)
    order = np.concatenate([rng.permutation(count) for _ in range(rounds)])[:iterations]
    return [int(index) for index in order]


class ViewPlan:
    """The views that each iteration trains, by index: random rounds over all.

    Args:
        count: number of views. each: views of an iteration.
        most: iterations there can be at most; the order of more begins again.
    """

    def __init__(self, count: int, each: int, most: int, rng: np.random.Generator) -> None:
        self._count = count
        self._order = view_order(count, most * each, rng)
        self._each = each
        self._next = 0
        self._left_out: set[int] = set()

    def leave_out(self, views: Iterable[int]) -> None:
        """These views have no turn any more; all of them cannot be left out."""
        self._left_out |= set(views)
        if len(self._left_out) == self._count:
            raise ValueError(f"all {self._count} views are left out; an update needs one")

    def take(self) -> list[int]:
        """The views of the next iteration."""
        return [self._next_view() for _ in range(self._each)]

    def _next_view(self) -> int:
        while True:
            view = self._order[self._next % len(self._order)]
            self._next += 1
            if view not in self._left_out:
                return view


def plan_samples(count: int, rng: np.random.Generator) -> list[NDArray[np.int64]]:
    """Disjoint random sets of ``NEIGHBOUR_SAMPLE`` of ``count`` Gaussians; they cover all, an iteration takes the next.

    A rest of less than a quarter of that joins the set before it: alone, a few Gaussians would carry the whole weight.
    """
    order = rng.permutation(count)
    size = min(NEIGHBOUR_SAMPLE, max(count, 1))
    cuts = list(range(size, count, size))
    if cuts and 4 * (count - cuts[-1]) < size:
        cuts.pop()
    return [np.sort(part) for part in np.split(order, cuts)]


def mask_weight(settings: UpdateSettings, moving: int, count: int) -> float:
    """Weight of the mask loss for a scene of ``count`` Gaussians of which so many move."""
    return settings.weights.mask if moving < count else settings.weights.mask_alone


COOLING = 0.15
"""Share of the iterations that follows the decision to stop: the rates fall to their end first, but of a layer that
would rest by then already."""

LOOK_EVERY = 10
"""Iterations between two looks at the probe views, where an update ends once it gains nothing."""

PROBE = 4
"""Iterations after which an update's own speed is worth more than what the updates before took."""

MAX_TIMED = 4000
"""Iterations that an update by the clock has at most."""

UNTIMED = 100
"""Iterations that are planned by the clock before any was measured."""

RATE = 0.3
"""How fast what a budget foresees follows what was."""
FOR_BIRTHS = 0.4
"""Of a budget, that fits of what is born may have: about an update's worth where something entered."""
AFTER_S = 0.05
"""Seconds after the last iteration that are foreseen before any frame was measured."""


class Stopping:
    """Decides how long one update goes on: so many iterations, as many as fit, or fewer once nothing is gained.

    Args:
        most: iterations there can be at most.
        end: moment of ``clock`` by which the last iteration has to be over, seconds; at least one is made. None: there
            are ``most`` iterations.
        iteration_seconds: seconds of an iteration in the updates before, or None where there was none.
        gain: every ``LOOK_EVERY`` iterations the probe views (training views, never those held out) are looked at;
            where their error fell by less than this share since the look before, the update cools down and ends.
            0: it does not look.
        first: share of the iterations before which it does not end so: what begins late has to have begun.

    Attributes:
        planned_so_far: (iteration, iterations in all) whenever what is planned changed.

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
        """Iterations in all, as seen before iteration ``done``, counted from 0; the update ends at ``done`` or less."""
        total = self._total(done)
        if self._stop is not None:
            total = min(total, self._stop)
        if not self.planned_so_far or self.planned_so_far[-1][1] != total:
            self.planned_so_far.append((done, total))
        return total

    def needs_error(self, done: int) -> bool:
        """True where it needs the error on the probe views after ``done`` iterations."""
        return self._gain > 0 and self._stop is None and done % LOOK_EVERY == 0

    def record_error(self, done: int, error: float) -> None:
        """Take the error on the probe views after ``done`` iterations, where ``needs_error`` said so."""
        total = self._total(done)
        if self._error is not None and done >= self._first * total and error > (1 - self._gain) * self._error:
            self._stop = done + max(1, round(COOLING * total))
        self._error = error

    def _total(self, done: int) -> int:
        """Iterations in all, but for an early end."""
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
    """Milliseconds that each frame of a scene may take; learns what comes before and after the iterations.

    Decoding comes before the iterations and is seen by the clock; comparing and checking the end, writing the
    checkpoint and the commit come after them and are foreseen.

    Attributes:
        milliseconds: a frame may take, None: as many as it needs. iteration_seconds: seconds of an iteration, None:
            not known yet.
        after: seconds from the last iteration to the end of the commit, without fits of what is born.
        births: whether the next frame has time for such fits, taken from its iterations: the one before had some.
    """

    def __init__(self, milliseconds: float | None) -> None:
        self.milliseconds = milliseconds
        self.iteration_seconds: float | None = None
        self.after = AFTER_S
        self.births = False

    def end(self, began: float) -> float | None:
        """The moment by which the last iteration has to be over, of a frame begun at ``began``; None: no limit."""
        kept = FOR_BIRTHS * self.births * (self.milliseconds or 0.0) / 1000
        return None if (end := self.end_of_births(began)) is None else end - kept

    def end_of_births(self, began: float) -> float | None:
        """The moment by which fits of what is born have to be over; None: no limit."""
        return None if self.milliseconds is None else began + self.milliseconds / 1000 - self.after

    def record_birth_fits(self, spent: float, postponed: Sequence[str]) -> None:
        """Take how long fits of what was born took, and which of them there was no time for."""
        kept = self.births  # time that was kept and was too short is not kept again
        self.births = bool(spent or postponed) and not (kept and postponed)

    def record_frame(self, moments: Sequence[float], seconds: Mapping[str, float], commit: float) -> None:
        """Take how long a frame took.

        Args:
            moments, seconds: of its update, see ``UpdateTrace``. commit: seconds that checking and writing took.
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
            )  # one slow frame is forgotten with the next
            self.after += RATE * (after - self.after)
