"""What each iteration of an update looks at, and how far it steps: the same on every device."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from math import cos, pi

import numpy as np
from numpy.typing import NDArray

from scas4d_core.gaussians import Gaussians
from scas4d_core.settings import UpdateSettings
from scas4d_core.structure.hierarchy import Hierarchy
from scas4d_core.update.views import TrainingView, ViewFactory, view_order

STANDARD_RADIUS_M = 4.0
"""The scene radius for which the translation rates of the layers are given."""


def first_iteration(start: float, iterations: int) -> int:
    """Number of the iteration, from 0, in which what begins after a share ``start`` of all takes its first step."""
    return round(start * iterations)


@dataclass(frozen=True)
class Rates:
    """Adam's rates per iteration; a rate of 0 leaves the parameter where it starts.

    Attributes:
        layers: (rotation r, translation t in metres, scaling c and s), one a layer, coarse to fine.
        position, rotation, scale, colour: of Δp in metres, ΔR, Δs, RGB of what moves. colour_standing: RGB of the rest.
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
            starts=tuple(settings.layer_starts[min(k, len(settings.layer_starts) - 1)] for k in range(layers)),
            start=settings.own_start,
        )


class ViewPlan:
    """Which views each iteration trains: random rounds over all, coarser pictures first where the settings say so.

    Args:
        most: iterations there can be at most; the order of more begins again.
    """

    def __init__(
        self,
        factory: ViewFactory,
        views: Sequence[TrainingView],
        settings: UpdateSettings,
        most: int,
        rng: np.random.Generator,
    ) -> None:
        self._factory = factory
        self._views = views
        self._order = view_order(len(views), most * settings.views, rng)
        self._each = settings.views
        self._until, self._scale = settings.coarse_until, settings.coarse_scale
        self._small: dict[int, TrainingView] = {}
        self._next = 0
        self._left_out: set[str] = set()

    def leave_out(self, names: Iterable[str]) -> None:
        """These cameras have no turn any more; all of them cannot be left out."""
        self._left_out |= set(names)
        if all(view.name in self._left_out for view in self._views):
            raise ValueError(f"all {len(self._views)} views are left out; an update needs one")

    def take(self, iteration: int, iterations: int) -> list[TrainingView]:
        """The next ``views`` views, for an iteration, counted from 0, of so many as are planned."""
        coarse = iteration < round(self._until * iterations)
        return [self._next_view(coarse) for _ in range(self._each)]

    def _next_view(self, coarse: bool) -> TrainingView:
        while True:
            index = self._order[self._next % len(self._order)]
            self._next += 1
            if self._views[index].name not in self._left_out:
                break
        if not coarse:
            return self._views[index]
        if index not in self._small:
            self._small[index] = self._factory.coarser(self._views[index], self._scale)
        return self._small[index]


def plan_samples(count: int, size: int, rng: np.random.Generator) -> list[NDArray[np.int64]]:
    """Disjoint random sets of ``size`` of ``count`` Gaussians that cover all: each iteration takes the next.

    A rest of less than a quarter of that joins the set before it: alone, a few Gaussians would carry the whole weight.
    """
    order = rng.permutation(count)
    size = min(size, max(count, 1))
    cuts = list(range(size, count, size))
    if cuts and 4 * (count - cuts[-1]) < size:
        cuts.pop()
    return [np.sort(part) for part in np.split(order, cuts)]


def mask_weight(settings: UpdateSettings, moving: int, count: int) -> float:
    """Weight of the mask loss for a scene of ``count`` Gaussians of which so many move."""
    return settings.weights.mask if moving < count else settings.weights.mask_alone


def first_lengths(hierarchy: Hierarchy, first: Gaussians) -> NDArray[np.float32]:
    """[M, 3] metres, lengths of the moving Gaussians' axes at frame 0, which the scale loss lets them have."""
    lengths: NDArray[np.float32] = np.sqrt(np.square(first.factors[hierarchy.rows]).sum(axis=1))
    return lengths
