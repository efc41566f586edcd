"""Schedule of an update, the same on every device: views, samples, weights and rates of each iteration; Adam's step."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from math import cos, pi

import numpy as np
from numpy.typing import NDArray

from scas4d_core.guards import GuardCounts
from scas4d_core.kernels.adam import ACTED, EVERY_ROW, adam
from scas4d_core.settings import UpdateSettings
from scas4d_core.update.views import TrainingView, view_order

Array = NDArray[np.float32]

STANDARD_RADIUS_M = 4.0
"""The scene radius for which the translation rates of the layers are given."""


LAYER_STARTS = (0.0, 0.2, 0.4)
"""Share of the iterations after which a layer begins to learn, coarse to fine; with more layers the last is repeated.
The coarse motion is found first: all at once, the finer layers take a part of it, each cluster another."""

NEIGHBOUR_SAMPLE = 4000
"""Gaussians whose neighbours are looked at an iteration: what the neighbour terms cost does not grow with the scene."""

IMAGE_WEIGHT = 1.0
"""Weight of the image loss, 0.8 L1 + 0.2 (1 − SSIM); those of the other terms (``Weights``) are relative to it."""

SOFT_COLOUR_WEIGHT = 0.01
"""Weight of the mean absolute change of the colours (Dynamic3DGaussians; the paper does not give it)."""


def first_iteration(start: float, iterations: int) -> int:
    """Number of the iteration, from 0, in which what begins after a share ``start`` of all takes its first step."""
    return round(start * iterations)


@dataclass(frozen=True)
class Rates:
    """Adam's rates per iteration; a rate of 0 leaves the parameter where it starts.

    Attributes:
        layers: (rotation r, translation t in metres, scaling c and s), one a layer, coarse to fine.
        position, rotation, scale, colour: of Δp in metres, ΔR, Δs, RGB of moving. colour_standing: RGB of the rest.
        end: all rates fall to this fraction in the last iteration, along half a cosine; 1 keeps them.
        beta1, beta2: Adam's decays.
        starts: share of the iterations after which a layer begins, one a layer; what is missing begins at once.
        start: the same of the Gaussians' own Δp, ΔR, Δs.
    """

    layers: tuple[tuple[float, float, float], ...]
    position: float
    rotation: float
    scale: float
    colour: float
    colour_standing: float = 0.0
    end: float = 1.0
    beta1: float = 0.9
    beta2: float = 0.999
    starts: tuple[float, ...] = ()
    start: float = 0.0

    def factor(self, iteration: int, iterations: int, start: float = 0.0) -> float:
        """Share of the rates in an iteration counted from 0, of what begins after a share of all; 0 before."""
        first = first_iteration(start, iterations)
        if iteration < first:
            return 0.0
        done = (iteration - first) / max(1, iterations - 1 - first)
        return self.end + (1 - self.end) * 0.5 * (1 + cos(pi * done))

    def start_of(self, layer: int) -> float:
        """Share of the iterations after which a layer begins."""
        return self.starts[layer] if layer < len(self.starts) else 0.0

    def hurried(self, factor: float) -> Rates:
        """Layers that turn and shift faster: where there is no motion to start from there is further to go."""
        return replace(self, layers=tuple((factor * r, factor * t, scaling) for r, t, scaling in self.layers))

    def tried(self, factor: float, rigid: bool, hold_colours: bool) -> Rates:
        """All rates times a factor; ``rigid``: of clusters that turn and shift only; ``hold_colours``: colours stay."""
        if (factor, rigid, hold_colours) == (1.0, False, False):
            return self
        own = 0.0 if rigid else factor
        return replace(
            self,
            layers=tuple((factor * r, factor * t, own * scaling) for r, t, scaling in self.layers),
            position=own * self.position,
            rotation=own * self.rotation,
            scale=own * self.scale,
            colour=0.0 if hold_colours else factor * self.colour,
            colour_standing=0.0 if hold_colours else factor * self.colour_standing,
        )

    @classmethod
    def of(cls, settings: UpdateSettings, layers: int, radius: float) -> Rates:
        """The rates of a scene of ``radius`` metres whose hierarchy has so many layers."""
        named = [settings.layer_rates[min(k, len(settings.layer_rates) - 1)] for k in range(layers)]
        return cls(
            layers=tuple((r.rotation, r.translation * radius / STANDARD_RADIUS_M, r.scaling) for r in named),
            position=settings.rate_position * radius,
            rotation=settings.rate_rotation,
            scale=settings.rate_scale,
            colour=settings.rate_colour,
            colour_standing=settings.rate_colour_standing,
            end=settings.rate_end,
            beta1=settings.beta1,
            beta2=settings.beta2,
            starts=tuple(LAYER_STARTS[min(k, len(LAYER_STARTS) - 1)] for k in range(layers)),
            start=settings.own_start,
        )


class ViewPlan:
    """The views that each iteration trains: random rounds over all.

    Args:
        each: views of an iteration. most: iterations there can be at most; the order of more begins again.
    """

    def __init__(self, views: Sequence[TrainingView], each: int, most: int, rng: np.random.Generator) -> None:
        self._views = views
        self._order = view_order(len(views), most * each, rng)
        self._each = each
        self._next = 0
        self._left_out: set[str] = set()

    def leave_out(self, names: Iterable[str]) -> None:
        """These cameras have no turn any more; all of them cannot be left out."""
        self._left_out |= set(names)
        if all(view.name in self._left_out for view in self._views):
            raise ValueError(f"all {len(self._views)} views are left out; an update needs one")

    def take(self) -> list[TrainingView]:
        """The views of the next iteration."""
        return [self._next_view() for _ in range(self._each)]

    def _next_view(self) -> TrainingView:
        while True:
            view = self._views[self._order[self._next % len(self._order)]]
            self._next += 1
            if view.name not in self._left_out:
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


def all_begun(settings: UpdateSettings) -> float:
    """Share of the iterations after which every layer and the Gaussians' own deltas learn."""
    return max(settings.own_start, *LAYER_STARTS)


class Adam:
    """Adam over one table of parameters, with a rate per column, times one per row where given.

    It begins after a share ``start`` of the iterations and leaves the table alone before. ``guards`` counts how often
    each guard of the step acted.
    """

    def __init__(
        self, parameters: Array, columns: list[float], rates: Rates, start: float = 0.0, by_row: Array = EVERY_ROW
    ) -> None:
        self._parameters = parameters
        self._by_row = by_row
        self._first, self._second = np.zeros_like(parameters), np.zeros_like(parameters)
        self._plan, self._start = rates, start
        self._rates = np.array(columns, np.float32)
        self._beta1, self._beta2 = np.float32(rates.beta1), np.float32(rates.beta2)
        self._steps = 0
        self.guards = GuardCounts(*ACTED)

    def step(self, gradients: Array, iteration: int, iterations: int) -> None:
        """Take the step of an iteration, counted from 0."""
        factor = self._plan.factor(iteration, iterations, self._start)
        if factor == 0:
            return
        self._steps += 1
        acted = adam(
            self._parameters, gradients, self._first, self._second, self._rates * np.float32(factor), self._by_row,
            self._beta1, self._beta2, self._steps,
        )  # fmt: skip
        self.guards.add(ACTED, acted)
