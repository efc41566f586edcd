"""Learning rate and active period of each parameter in an update, identical on every engine.

Coarse motion is found first, because a layer of clusters starts after the layers above it. If the previous motion
predicts the frame well, coarse layers are frozen before the finer ones. Their remaining fluctuation from view to view
would move thousands of Gaussians. If the prediction is poor, all layers learn to the end.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from math import cos, pi
from typing import TYPE_CHECKING, NamedTuple

from scas4d_core.engines.freedom import Freedom
from scas4d_core.engines.plan import ColourPlan

if TYPE_CHECKING:
    from scas4d_core.settings import UpdateSettings

RATE_SCALING = 0.002
"""Learning rate per iteration of a cluster's scaling parameters c (1/m) and s."""
STANDARD_RADIUS_M = 4.0
"""Scene radius to which the layers' translation rates refer, in metres."""


LAYER_STARTS = (0.0, 0.2, 0.4)
"""Share of the iterations after which a layer starts to learn, coarse to fine. With more layers, the last value
repeats. If all layers started at once, each cluster of the finer layers would absorb part of the coarse motion."""

LAYER_ENDS = (0.5, 0.75, 1.0)
"""Share of the iterations after which a layer is frozen, coarse to fine. 0.5 to 0.6 and 0.7 to 0.8 gave similar
results."""
FIRST_UPDATE_LAYER_ENDS = (0.8, 0.9, 1.0)
"""Same as ``LAYER_ENDS``, but for the first update, which runs in several view orders. If one order misses a motion,
another may find it. These values gained 0.0 to 0.5 dB."""
NEAR_FINEST = 4.0
"""Factor on the rates of the finest layer if the layers above it are frozen early."""
NEAR_OWN = 2.0
"""Same as ``NEAR_FINEST``, but for the Gaussians' own displacements, which account for the remaining motion. Their
rotations and scales keep their rates, because synthetic scenes fit less well with higher rates."""
LEAST_TIME = 0.3
"""Minimum share of the iterations in which a layer learns before it is frozen."""
NEAR = 0.6
"""Maximum unexplained share of the change for early freezing of layers. With every second frame left out, the share was
about 0.55 to 1.2, and unconditional freezing cost 0.6 to 3.5 dB (docs/tried.md)."""


FASTER_IN_CHANGING_LIGHT = 2.0
"""Factor on the rate of static colours while the lighting changes. It gains 0.1 to 0.2 dB for a lamp that crosses a
room."""


def first_iteration(start: float, iterations: int) -> int:
    """Returns the index of the first iteration of a parameter that starts after the share ``start`` of the update."""
    return round(start * iterations)


def learning_span(start: float, rest: float, iterations: int) -> range:
    """Returns the indices of the iterations in which a parameter learns; at least one iteration.

    Args:
        start, rest: shares of the iterations after which the parameter starts and stops learning.
        iterations: total number of iterations.

    >>> learning_span(0.25, 0.75, 8), learning_span(0.4, 0.5, 2)
    (range(2, 6), range(1, 2))
    """
    first = first_iteration(start, iterations)
    return range(first, max(first + 1, first_iteration(rest, iterations)))


@dataclass(frozen=True)
class Rates:
    """Adam learning rates per iteration. With a rate of 0, a parameter keeps its initial value.

    Attributes:
        layers: rates of rotation r, translation t (in metres), and scaling c and s of each layer, coarse to fine.
        position: rate of Δp, in metres.
        rotation: rate of ΔR.
        scale: rate of Δs.
        colour: rate of the RGB of moving Gaussians.
        static_colour: rate of the RGB of static Gaussians.
        end: fraction to which a rate decays on a half-cosine until its layer is frozen or the update ends. With 1,
            the rates are constant.
        beta1, beta2: decay rates of Adam.
        layer_starts: share of the iterations after which each layer starts to learn; missing layers start at once.
        layer_ends: share of the iterations after which each layer is frozen; missing layers learn to the end.
        start: share of the iterations after which the Gaussians' own Δp, ΔR and Δs start to learn.
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
        """Returns the factor on a parameter's rate in an iteration, which is 0 while the parameter is not learnt.

        A parameter learns for at least one iteration.

        Args:
            iteration: index of the iteration.
            iterations: total number of iterations.
            start, rest: shares of the iterations after which the parameter starts and stops learning.

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
        """Returns the share of the iterations after which a layer starts."""
        return self.layer_starts[layer] if layer < len(self.layer_starts) else 0.0

    def layer_end(self, layer: int) -> float:
        """Returns the share of the iterations after which a layer is frozen, or 1 if it learns to the end."""
        return self.layer_ends[layer] if layer < len(self.layer_ends) else 1.0

    def frozen_layers(self, iteration: int, iterations: int) -> int:
        """Returns the number of layers, coarsest first, that are frozen in an iteration counted from 0."""
        ends = (
            learning_span(self.layer_start(k), self.layer_end(k), iterations).stop for k in range(len(self.layer_ends))
        )
        return next((k for k, end in enumerate(ends) if iteration < end), len(self.layer_ends))

    def restricted_to(self, freedom: Freedom) -> Rates:
        """Returns the rates with 0 for deformation parameters that are not free.

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
        """Returns the colour rates of moving and static Gaussians, or 0 for those that the plan does not enable."""
        if plan is None:
            return 0.0, 0.0
        moving, static = self.colour, self.static_colour
        if plan.changing_light:
            static = FASTER_IN_CHANGING_LIGHT * static
            moving = max(moving, static)
        return moving if plan.moving else 0.0, static if plan.static else 0.0

    def for_cold_start(self, factor: float, several_orders: bool = False) -> Rates:
        """Returns the rates for an update without a previous motion.

        The rates of the layers' rotations and translations are multiplied by ``factor``, because the layers have
        farther to move. Layers are frozen early only if the update runs in several view orders.
        """
        layers = tuple((factor * r, factor * t, scaling) for r, t, scaling in self.layers)
        return replace(
            self,
            layers=layers,
            layer_ends=_layer_ends(FIRST_UPDATE_LAYER_ENDS, self.layer_starts) if several_orders else (),
        )

    def for_warm_start(self, unexplained: float) -> Rates:
        """Returns the rates for a warm start, given the share of the change that the previous motion does not explain.

        If the share is at most ``NEAR``, layers are frozen early, and the finest layer and the Gaussians' own Δp learn
        faster. Otherwise no layer is frozen.
        """
        if not unexplained <= NEAR:  # also true for NaN
            return replace(self, layer_ends=())
        if len(self.layers) < 2:
            return self
        *above, (rotation, translation, scaling) = self.layers
        layers = (*above, (NEAR_FINEST * rotation, NEAR_FINEST * translation, NEAR_FINEST * scaling))
        return replace(self, layers=layers, position=NEAR_OWN * self.position)

    def for_attempt(self, factor: float, rigid: bool, freeze_colours: bool) -> Rates:
        """Returns all rates multiplied by a factor.

        Args:
            factor: factor on all rates.
            rigid: whether only cluster rotations and translations are learnt.
            freeze_colours: whether colours are frozen.
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
        """Returns the rates from the settings.

        Args:
            settings: update settings.
            layers: number of layers of clusters.
            radius: reach of the rig in metres (``Rig.reach``), which scales the rates of translations.
        """
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


class StepFactors(NamedTuple):
    """Factors on the learning rates in one iteration, which are 0 for parameters that are not learnt.

    Attributes:
        frozen: number of frozen layers, coarsest first.
        layers: factor of each layer, coarse to fine.
        own: factor of the Gaussians' own Δp, ΔR and Δs.
        colour: factor of the colours.
    """

    frozen: int
    layers: tuple[float, ...]
    own: float
    colour: float


@lru_cache(maxsize=2048)  # most updates have the same rates and number of iterations
def step_factors(rates: Rates, iteration: int, iterations: int) -> StepFactors:
    """Returns the factors on the rates in an iteration, counted from 0."""
    layers = (
        rates.factor(iteration, iterations, rates.layer_start(layer), rates.layer_end(layer))
        for layer in range(len(rates.layers))
    )
    own, colour = rates.factor(iteration, iterations, rates.start), rates.factor(iteration, iterations)
    return StepFactors(rates.frozen_layers(iteration, iterations), tuple(layers), own, colour)


def _layer_ends(layer_ends: tuple[float, ...], layer_starts: tuple[float, ...]) -> tuple[float, ...]:
    """Returns the share of the iterations after which each layer is frozen, at least ``LEAST_TIME`` after its start.

    For fewer layers than values, the last values of ``layer_ends`` are used. For more layers, the first value repeats.
    """
    ends = (layer_ends[max(k - len(layer_starts), -len(layer_ends))] for k in range(len(layer_starts)))
    return tuple(min(1.0, max(end, start + LEAST_TIME)) for end, start in zip(ends, layer_starts, strict=True))


def latest_start(settings: UpdateSettings) -> float:
    """Returns the share of the iterations after which all layers and the Gaussians' own deltas learn."""
    return max(settings.deltas_start, *LAYER_STARTS)
