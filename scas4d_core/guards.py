"""Table of every clamp, floor and epsilon in the core's arithmetic, with name, value, unit and reason.

There are two tables. A *guard* acts only when a value would become non-finite. Each action is counted, so that a guard
cannot hide a fault. A *convention* is part of the method: it always acts and is not counted. Kernels import the values;
``kernels.cache`` recompiles them when a value changes.

``scripts/bench stability`` prints both tables with their counts over the catalogue of hard cases. It also disables each
entry in turn to find the cases that then fail.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Guard:
    """A numerical constant that the arithmetic needs in addition to the equations.

    Attributes:
        name: key of the entry and of its count.
        value: in ``unit``.
        without: value that disables the guard; NaN if disabling it needs another change.
        where: files under ``scas4d_core``.
        reason: purpose and effect of the guard.
        counted: unit of its count; for a convention, the reason why it is not counted.
    """

    name: str
    value: float
    without: float
    unit: str
    where: str
    reason: str
    counted: str


GUARDS: dict[str, Guard] = {}
"""Guards by name; their actions are counted."""
CONVENTIONS: dict[str, Guard] = {}
"""Conventions by name; they are part of the method and are not counted."""


def _guard(name: str, value: float, without: float, *, unit: str, where: str, reason: str, counted: str) -> float:
    GUARDS[name] = Guard(name, value, without, unit, where, reason, counted)
    return value


def _convention(name: str, value: float, without: float, *, unit: str, where: str, reason: str, counted: str) -> float:
    CONVENTIONS[name] = Guard(name, value, without, unit, where, reason, counted)
    return value


NAN = float("nan")
INFINITY = float("inf")

# Rendering.

NOT_FINITE = _guard(
    "not_finite", 1e15, NAN,
    unit="m", where="kernels/projection.py, engines/torch/rasterizer.py",
    reason="A Gaussian is left out if its mean, factor, opacity or features are NaN, infinite or larger: it would turn "
    "every pixel that it reaches into NaN. Its gradients are 0.",
    counted="Gaussians left out of a picture",
)  # fmt: skip
FEATURE_CEILING = _guard(
    "feature_ceiling", 1e9, INFINITY,
    unit="1", where="kernels/projection.py, engines/torch/rasterizer.py",
    reason="The same for larger features: the fourth powers in SSIM would overflow. Colours are nominally 0…1.",
    counted="under not_finite",
)  # fmt: skip
FOOTPRINT_CEILING = _guard(
    "footprint_ceiling", 1e30, INFINITY,
    unit="pixels⁴", where="kernels/projection.py",
    reason="A Gaussian is left out if the determinant of its projected covariance is larger (3e7 pixels wide) or not "
    "positive: the conic is a quotient of numbers that would overflow.",
    counted="Gaussians left out of a picture",
)  # fmt: skip
GRADIENT_NOT_FINITE = _guard(
    "gradient_not_finite", 1e30, NAN,
    unit="loss per unit", where="kernels/projection.py",
    reason="A Gaussian whose gradient overflows in the backward pass gets none: through the pivots and the clusters' "
    "sums it would reach every other.",
    counted="Gaussians without gradient in a backward pass",
)  # fmt: skip

# Deformation.

HELD_BACK = _guard(
    "held_back", 0.0, NAN,
    unit="–", where="engines/cpu/deformation.py",
    reason="A Gaussian that is not finite at the start of an update stays unchanged: the pivot of its cluster, a mean, "
    "would be NaN, and so would the whole cluster. It weighs nothing in pivots and neighbour terms.",
    counted="Gaussians held back in an update",
)  # fmt: skip
EMPTY_CLUSTER = _guard(
    "empty_cluster", 1.0, 0.0,
    unit="Gaussians", where="kernels/cascade.py, engines/torch/deformation.py",
    reason="Smallest count by which a pivot's sum is divided: a cluster without a finite Gaussian has the pivot 0 "
    "instead of NaN, which its gradient would spread.",
    counted="clusters without a Gaussian in an update",
)  # fmt: skip
EXPONENT = _guard(
    "exponent", 125.5, 1e9,
    unit="powers of 2", where="kernels/lanes.py, kernels/jit.py",
    reason="Arguments of exponentials are clamped to ±87 (e^87 = 6e37): beyond, float32 overflows and the bits of the "
    "result are garbage. In the cluster map a factor stays above 3e-38.",
    counted="Gaussians in a layer whose factor, or in an update whose stretch (Δs), is clamped",
)  # fmt: skip
HALF_TURN = _guard(
    "half_turn", 1e-12, 0.0,
    unit="1", where="kernels/cascade.py, engines/torch/deformation.py",
    reason="Floor of the polar rotation's cosine part and of the radius that divides it: a map that folds space "
    "straight back has no rotation of its own; it counts as none instead of 0/0.",
    counted="Gaussians in a layer, forward",
)  # fmt: skip

# Steps.

GRADIENT_CEILING = _guard(
    "gradient_ceiling", 1e18, INFINITY,
    unit="loss per unit", where="kernels/adam.py",
    reason="Gradients are clamped to ± this value, NaN to 0: their squares would overflow, the second moment would "
    "stay infinite, and the parameter would not move for the rest of the update.",
    counted="numbers of a gradient in a step",
)  # fmt: skip
MOMENT_FLOOR = _guard(
    "moment_floor", 1e-19, 0.0,
    unit="loss per unit", where="kernels/adam.py",
    reason="Smaller gradients and first moments are 0, and second moments below its square: they would be denormal "
    "numbers, with which a step takes 3.5 times as long (docs/stability.md), for the rest of the update.",
    counted="numbers of a gradient in a step",
)  # fmt: skip

# Frame 0.

QUATERNION_FLOOR = _guard(
    "quaternion_floor", 1e-30, -1.0,
    unit="1", where="kernels/activation.py",
    reason="A quaternion with at most this squared length counts as no rotation: it has no direction, and gets no "
    "gradient.",
    counted="Gaussians in an activation",
)  # fmt: skip
LEFT_OUT = _guard(
    "left_out_of_hierarchy", 0.0, NAN,
    unit="–", where="structure/hierarchy.py",
    reason="A moving Gaussian that is not finite belongs to no cluster and stays in place: K-means would refuse all "
    "others.",
    counted="Gaussians in a clustering",
)  # fmt: skip

# Conventions: they always act.

ALPHA_FLOOR = _convention(
    "alpha_floor", 1.0 / 255.0, 1e-8,
    unit="1", where="engines/limits.py",
    reason="A Gaussian covers exactly the pixels where its alpha is at least this; 8-bit pictures cannot show less.",
    counted="ends the support of every Gaussian",
)  # fmt: skip
ALPHA_CAP = _convention(
    "alpha_cap", 0.99, 1.0,
    unit="1", where="engines/limits.py",
    reason="No single Gaussian is opaque: 1/(1 − alpha) of the backward pass stays below 100.",
    counted="meets every opaque Gaussian's middle, pixel by pixel",
)  # fmt: skip
TRANSMITTANCE_STOP = _convention(
    "transmittance_stop", 1e-4, 0.0,
    unit="1", where="engines/limits.py",
    reason="A pixel is finished once less light than this would pass; what is left never gets denormal.",
    counted="ends every opaque pixel",
)  # fmt: skip
LOW_PASS = _convention(
    "low_pass", 0.3, 0.0,
    unit="pixels²", where="engines/limits.py",
    reason="Added to the diagonal of the projected covariance: a Gaussian is at least a pixel wide, and the covariance "
    "definite whatever its factor.",
    counted="added to every Gaussian",
)  # fmt: skip
NEAR = _convention(
    "near", 0.01, -INFINITY,
    unit="m", where="engines/limits.py",
    reason="Nearer Gaussians are not drawn: the projection has its pole at depth 0.",
    counted="culls in every picture, as the sides of the picture do",
)  # fmt: skip
TANGENT_MARGIN = _convention(
    "tangent_margin", 0.3, 1e9,
    unit="halves of the picture", where="engines/limits.py",
    reason="How far beyond the border x/z may lie before the projection's Jacobian is taken at the clamped place: "
    "89° off the axis the linear footprint would cover the picture.",
    counted="holds every Gaussian beside the picture",
)  # fmt: skip
COVER_SLACK = _convention(
    "cover_slack", 1e-4, 0.0,
    unit="1 and σ²", where="kernels/tiles.py",
    reason="Relative and absolute widening of the support by which tiles and blocks are culled: rounding must not cull "
    "what blending would draw. No pixel changes by it.",
    counted="widens every support",
)  # fmt: skip
ROOT_FLOOR = _convention(
    "root_floor", 1e-20, 0.0,
    unit="m²", where="kernels/neighbour_terms.py, engines/torch/losses.py",
    reason="Under the roots of the neighbour terms, as in Dynamic3DGaussians: where nothing has moved the gradient is "
    "0, not NaN.",
    counted="part of every pair's term",
)  # fmt: skip
ADAM_EPSILON = _convention(
    "adam_epsilon", 1e-15, 0.0,
    unit="loss per unit", where="kernels/adam.py",
    reason="Adam's own, as in Dynamic3DGaussians: gradients of single Gaussians are far below the usual 1e-8.",
    counted="part of every step",
)  # fmt: skip
SSIM_C1 = _convention(
    "ssim_c1", 0.01**2, 0.0,
    unit="1", where="kernels/image_loss.py, engines/torch/losses.py",
    reason="SSIM's own (Wang et al. 2004): means that are both black compare as equal.",
    counted="part of every window",
)  # fmt: skip
SSIM_C2 = _convention(
    "ssim_c2", 0.03**2, 0.0,
    unit="1", where="kernels/image_loss.py, engines/torch/losses.py",
    reason="SSIM's own: windows that are both flat compare as equal.",
    counted="part of every window",
)  # fmt: skip
SMALLEST_SQUARE = _convention(
    "smallest_square", 1e-9, 0.0,
    unit="1", where="engines/torch/losses.py, engines/renderer.py",
    reason="Sum of squared differences below which two pictures count as equal: PSNR stays finite.",
    counted="acts on a reported figure, not on the state",
)  # fmt: skip


class GuardCounts(Mapping[str, int]):
    """Counts of guard actions since the last ``reset``, by name.

    >>> counts = GuardCounts("gradient_ceiling", "moment_floor")
    >>> counts.add(("gradient_ceiling", "moment_floor"), np.array([[2, 0], [1, 5]]))  # from two tasks
    >>> dict(counts)
    {'gradient_ceiling': 3, 'moment_floor': 5}
    """

    def __init__(self, *names: str) -> None:
        unknown = set(names) - set(GUARDS) - set(OBSERVED)
        if unknown:
            raise ValueError(f"guards {sorted(unknown)} are unknown; the table in scas4d_core/guards.py names all")
        self._counts = dict.fromkeys(names, 0)

    def add(self, names: Sequence[str], guard_counts: NDArray[np.int64]) -> None:
        """Adds the counts of a kernel's tasks, [tasks, names] or [names], to the named guards."""
        counts = guard_counts.reshape(-1, len(names)).sum(axis=0)
        for name, count in zip(names, counts.tolist(), strict=True):
            self._counts[name] += count

    def reset(self) -> None:
        """Sets all counts to 0."""
        self._counts = dict.fromkeys(self._counts, 0)

    def __getitem__(self, name: str) -> int:
        return self._counts[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._counts)

    def __len__(self) -> int:
        return len(self._counts)

    def __repr__(self) -> str:
        return f"GuardCounts({self._counts})"


OBSERVED = {
    "folded": "Gaussians in a layer, forward, where the cluster map turns space inside out: det J ≤ 0. Nothing is "
    "clamped; the state stays finite, and a fold can be undone by the next steps.",
}
"""Events that are counted like guards but change no value."""


def summed(counts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """Returns the sum of several counts by name."""
    total: dict[str, int] = {}
    for each in counts:
        for name, count in each.items():
            total[name] = total.get(name, 0) + count
    return total
