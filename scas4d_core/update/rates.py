"""Rates of an update, the same on every engine: how fast each parameter learns, and when.

The coarse motion is found first. A layer of clusters begins once those above it have begun. Where the motion before
leads near what a frame shows, it rests before those below it do: what it still shakes by, from view to view, would be a
motion of thousands of Gaussians. Where there is further to go, all learn to the end.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import cos, pi
from typing import TYPE_CHECKING

from scas4d_core.engines.freedom import Freedom
from scas4d_core.engines.plan import ColourPlan

if TYPE_CHECKING:
    from scas4d_core.settings import UpdateSettings

RATE_SCALING = 0.002
"""Of c (1/m) and s of a cluster, per iteration."""
STANDARD_RADIUS_M = 4.0
"""The scene radius for which the translation rates of the layers are given."""


LAYER_STARTS = (0.0, 0.2, 0.4)
"""Share of the iterations after which a layer begins to learn, coarse to fine; with more layers the last is repeated.
The coarse motion is found first: all at once, the finer layers take a part of it, each cluster another."""

LAYER_ENDS = (0.5, 0.75, 1.0)
"""Share of the iterations after which a layer rests, coarse to fine. 0.5 to 0.6 and 0.7 to 0.8 came out alike
(docs/tried.md)."""
FIRST_UPDATE_LAYER_ENDS = (0.8, 0.9, 1.0)
"""The same of the first update, which is tried in several orders of its views: what one has not found by then, another
finds. It gained 0.0 to 0.5 dB (docs/tried.md)."""
NEAR_FINEST = 4.0
"""Times its rates that the finest layer learns by where the layers above it rest, ..."""
NEAR_OWN = 2.0
"""... and the Gaussians' own displacement: what is left to find is theirs. Their turns and scales learn as ever: where
they learn faster, made-up scenes are met less well (docs/tried.md)."""
LEAST_TIME = 0.3
"""Share of the iterations that a layer has at least before it rests."""
NEAR = 0.6
"""Share of what changed that the motion before may leave unexplained, where layers rest. With every second frame left
out it left about 0.55 to 1.2, and layers that always rested cost 0.6 to 3.4 dB (docs/tried.md)."""


FASTER_IN_CHANGING_LIGHT = 2.0
"""Times the rate of static Gaussians' colours, where the light changes: 0.1 to 0.2 dB on a lamp that crosses a room."""


def first_iteration(start: float, iterations: int) -> int:
    """Number of the iteration, from 0, in which what begins after a share ``start`` of all takes its first step."""
    return round(start * iterations)


def learning_span(start: float, rest: float, iterations: int) -> range:
    """The iterations, from 0, in which what learns from one share of all to another takes its steps: one at least.

    >>> learning_span(0.25, 0.75, 8), learning_span(0.4, 0.5, 2)
    (range(2, 6), range(1, 2))
    """
    first = first_iteration(start, iterations)
    return range(first, max(first + 1, first_iteration(rest, iterations)))


@dataclass(frozen=True)
class Rates:
    """Adam's rates per iteration; a rate of 0 leaves the parameter where it starts.

    Attributes:
        layers: (rotation r, translation t in metres, scaling c and s), one a layer, coarse to fine.
        position, rotation, scale, colour: of Δp in metres, ΔR, Δs, RGB of moving. static_colour: RGB of the rest.
        end: rates fall to this fraction in the last iteration before what they are of rests, or the update ends, along
            half a cosine; 1 keeps them.
        beta1, beta2: Adam's decays.
        layer_starts: share of the iterations after which a layer begins, one a layer; what is missing begins at once.
        layer_ends: share of the iterations after which it rests; what is missing goes on to the end.
        start: as ``layer_starts``, of the Gaussians' own Δp, ΔR, Δs.
    """

    layers: tuple[tuple[float, float, float], ...]
    position: float
    rotation: float
    scale: float
    colour: float
    static_colour: float = 0.0
    end: float = 1.0
    beta1: float = 0.9
    beta2: float = 0.999
    layer_starts: tuple[float, ...] = ()
    layer_ends: tuple[float, ...] = ()
    start: float = 0.0

    def factor(self, iteration: int, iterations: int, start: float = 0.0, rest: float = 1.0) -> float:
        """Share of the rates in an iteration counted from 0, of what learns from one share of all to another; else 0.

        It learns for one iteration at least.

        >>> rates = Rates((), 0, 0, 0, 0, end=0.2)
        >>> [round(rates.factor(i, 8, 0.25, 0.75), 2) for i in range(8)]
        [0.0, 0.0, 1.0, 0.8, 0.4, 0.2, 0.0, 0.0]
        """
        span = learning_span(start, rest, iterations)
        if iteration not in span:
            return 0.0
        done = (iteration - span.start) / max(1, len(span) - 1)
        return self.end + (1 - self.end) * 0.5 * (1 + cos(pi * done))

    def layer_start(self, layer: int) -> float:
        """Share of the iterations after which a layer begins."""
        return self.layer_starts[layer] if layer < len(self.layer_starts) else 0.0

    def layer_end(self, layer: int) -> float:
        """Share of the iterations after which a layer rests; 1 where it goes on to the end."""
        return self.layer_ends[layer] if layer < len(self.layer_ends) else 1.0

    def frozen_layers(self, iteration: int, iterations: int) -> int:
        """Number of layers, from the coarsest on, that do not learn any more in an iteration counted from 0."""
        ends = (
            learning_span(self.layer_start(k), self.layer_end(k), iterations).stop for k in range(len(self.layer_ends))
        )
        return next((k for k, end in enumerate(ends) if iteration < end), len(self.layer_ends))

    def restricted_to(self, freedom: Freedom) -> Rates:
        """The rates with those of the deformation's parameters that are not free at 0.

        >>> rates = Rates(((0.1, 0.2, 0.3),), position=0.4, rotation=0.5, scale=0.6, colour=0.7)
        >>> rates.restricted_to(Freedom(cluster_translation=True, own_scale=True))
        Rates(layers=((0.0, 0.2, 0.0),), position=0.0, rotation=0.0, scale=0.6, colour=0.7, ...)
        """
        free = (freedom.cluster_rotation, freedom.cluster_translation, freedom.cluster_scaling)
        return replace(
            self,
            layers=tuple((r * free[0], t * free[1], scaling * free[2]) for r, t, scaling in self.layers),
            position=self.position * freedom.own_position,
            rotation=self.rotation * freedom.own_rotation,
            scale=self.scale * freedom.own_scale,
        )

    def colour_rates(self, plan: ColourPlan | None) -> tuple[float, float]:
        """Rates of the colours of moving and of static Gaussians, as a plan frees them."""
        if plan is None:
            return 0.0, 0.0
        moving, static = self.colour, self.static_colour
        if plan.changing_light:
            static = FASTER_IN_CHANGING_LIGHT * static
            moving = max(moving, static)
        return moving if plan.moving else 0.0, static if plan.static else 0.0

    def for_cold_start(self, factor: float, several_orders: bool = False) -> Rates:
        """Without a motion to start from: layers turn and shift faster, as there is further to go.

        None rests but in an update that is tried in ``several_orders`` orders of its views.
        """
        layers = tuple((factor * r, factor * t, scaling) for r, t, scaling in self.layers)
        return replace(
            self,
            layers=layers,
            layer_ends=_layer_ends(FIRST_UPDATE_LAYER_ENDS, self.layer_starts) if several_orders else (),
        )

    def for_warm_start(self, unexplained: float) -> Rates:
        """From the motion before, where that leaves so much of what changed unexplained.

        Where it leads near (``NEAR``), layers rest, and what is below them learns faster; else none rests.
        """
        if not unexplained <= NEAR:  # or not a number
            return replace(self, layer_ends=())
        if len(self.layers) < 2:
            return self
        *above, (rotation, translation, scaling) = self.layers
        layers = (*above, (NEAR_FINEST * rotation, NEAR_FINEST * translation, NEAR_FINEST * scaling))
        return replace(self, layers=layers, position=NEAR_OWN * self.position)

    def for_attempt(self, factor: float, rigid: bool, freeze_colours: bool) -> Rates:
        """All rates times a factor; ``rigid``: of clusters that turn and shift only; ``freeze_colours``: colours
        stay.
        """
        if (factor, rigid, freeze_colours) == (1.0, False, False):
            return self
        own = 0.0 if rigid else factor
        return replace(
            self,
            layers=tuple((factor * r, factor * t, own * scaling) for r, t, scaling in self.layers),
            position=own * self.position,
            rotation=own * self.rotation,
            scale=own * self.scale,
            colour=0.0 if freeze_colours else factor * self.colour,
            static_colour=0.0 if freeze_colours else factor * self.static_colour,
        )

    @classmethod
    def of(cls, settings: UpdateSettings, layers: int, radius: float) -> Rates:
        """The rates of a scene whose cameras reach ``radius`` metres (``Rig.reach``), for so many layers."""
        layer_starts = tuple(LAYER_STARTS[min(k, len(LAYER_STARTS) - 1)] for k in range(layers))
        named = [settings.layer_rates[min(k, len(settings.layer_rates) - 1)] for k in range(layers)]
        return cls(
            layers=tuple((r.rotation, r.translation * radius / STANDARD_RADIUS_M, RATE_SCALING) for r in named),
            position=settings.rate_position * radius,
            rotation=settings.rate_rotation,
            scale=settings.rate_scale,
            colour=settings.rate_colour,
            static_colour=settings.rate_static_colour,
            end=settings.final_rate,
            beta1=settings.beta1,
            beta2=settings.beta2,
            layer_starts=layer_starts,
            layer_ends=_layer_ends(LAYER_ENDS, layer_starts),
            start=settings.deltas_start,
        )


def _layer_ends(layer_ends: tuple[float, ...], layer_starts: tuple[float, ...]) -> tuple[float, ...]:
    """When each layer rests: of fewer layers the last of ``layer_ends``, of more the first is repeated; none too
    soon.
    """
    ends = (layer_ends[max(k - len(layer_starts), -len(layer_ends))] for k in range(len(layer_starts)))
    return tuple(min(1.0, max(end, start + LEAST_TIME)) for end, start in zip(ends, layer_starts, strict=True))


def latest_start(settings: UpdateSettings) -> float:
    """Share of the iterations after which every layer and the Gaussians' own deltas learn."""
    return max(settings.deltas_start, *LAYER_STARTS)
