"""Numerical constants of the core: every clamp, floor and epsilon, with its value, unit and reason.

There are two tables of constants. A *guard* acts only when a value would otherwise become
non-finite, undefined or denormal. Every action of a guard is counted, so that guards cannot hide a
fault. A *convention* is part of the method: it always acts, and its actions are not counted.
Kernels import the values, and ``kernels.cache`` recompiles the kernels when a value changes.

``tests/core/test_hard_cases.py`` runs a catalogue of hard cases. Its long version also disables each
constant in turn, and checks that a case then fails.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Guard:
    """Numerical constant that the arithmetic needs in addition to the equations.

    Attributes:
        name: key of the entry and of its count.
        value: value of the constant, in ``unit``.
        without: value that disables the guard, or NaN if the code must be changed to disable it.
        unit: unit of the value.
        where: files in ``scas4d_core`` that use the constant.
        reason: effect and purpose of the guard. The first clause describes the effect.
        counted: description of what is counted; for a convention, where or when it acts.
    """

    name: str
    value: float
    without: float
    unit: str
    where: str
    reason: str
    counted: str


GUARDS: dict[str, Guard] = {}
"""Guards, keyed by name; their actions are counted."""
CONVENTIONS: dict[str, Guard] = {}
"""Conventions, keyed by name; they are part of the method and are not counted."""


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
    reason="A Gaussian is skipped if its mean, factor, opacity or features are NaN or exceed this value: it would turn "
    "every pixel that it covers into NaN. Its gradients are 0.",
    counted="Gaussians skipped in an image",
)  # fmt: skip
FEATURE_CEILING = _guard(
    "feature_ceiling", 1e9, INFINITY,
    unit="1", where="kernels/projection.py, engines/torch/rasterizer.py",
    reason="A Gaussian is also skipped if a feature exceeds this value: the fourth powers in SSIM would overflow. "
    "Colours are nominally in [0, 1].",
    counted="included in not_finite",
)  # fmt: skip
FOOTPRINT_CEILING = _guard(
    "footprint_ceiling", 1e30, INFINITY,
    unit="pixels⁴", where="kernels/projection.py",
    reason="A Gaussian is skipped if the determinant of its projected covariance exceeds this value (3e7 pixels wide) "
    "or is not positive: the conic is a quotient of numbers that would overflow.",
    counted="Gaussians skipped in an image",
)  # fmt: skip
GRADIENT_NOT_FINITE = _guard(
    "gradient_not_finite", 1e30, NAN,
    unit="loss per unit", where="kernels/projection.py",
    reason="If a gradient of a Gaussian overflows in the backward pass, all its gradients are set to 0: pivots and "
    "cluster sums would spread it to all other Gaussians.",
    counted="Gaussians whose gradients are discarded in a backward pass",
)  # fmt: skip

# Deformation.

HELD_BACK = _guard(
    "held_back", 0.0, NAN,
    unit="–", where="engines/cpu/deformation.py",
    reason="A Gaussian with non-finite values at the start of an update is left unchanged: otherwise, the pivot of its "
    "cluster, which is a mean, and thus the whole cluster would be NaN. Its weight in pivots and neighbour terms is 0.",
    counted="Gaussians left unchanged in an update",
)  # fmt: skip
EMPTY_CLUSTER = _guard(
    "empty_cluster", 1.0, 0.0,
    unit="Gaussians", where="kernels/cascade.py, engines/torch/deformation.py",
    reason="The sum of a pivot is divided by at least this count: a cluster without finite Gaussians then has pivot 0 "
    "instead of NaN, which gradients would spread.",
    counted="clusters without a Gaussian in an update",
)  # fmt: skip
EXPONENT = _guard(
    "exponent", 125.5, 1e9,
    unit="powers of 2", where="kernels/lanes.py, kernels/jit.py",
    reason="Arguments of exponentials are clamped to ±87 (e^87 = 6e37): beyond that, float32 overflows and the result "
    "is meaningless. In the cluster map, the clamp keeps factors above 3e-38.",
    counted="Gaussians whose factor is clamped in a layer, or whose stretch (Δs) is clamped in an update",
)  # fmt: skip
HALF_TURN = _guard(
    "half_turn", 1e-12, 0.0,
    unit="1", where="kernels/cascade.py, engines/torch/deformation.py",
    reason="Lower bound of the cosine part of the polar rotation and of the radius that divides it: a map that folds "
    "space straight back has no defined rotation and gets the identity instead of 0/0.",
    counted="Gaussians in the forward pass of a layer",
)  # fmt: skip

# Steps.

GRADIENT_CEILING = _guard(
    "gradient_ceiling", 1e18, INFINITY,
    unit="loss per unit", where="kernels/adam.py",
    reason="Gradients are clamped to ± this value, and NaN is replaced by 0: their squares would overflow, the second "
    "moment would stay infinite, and the parameter would not change for the rest of the update.",
    counted="gradient components in a step",
)  # fmt: skip
MOMENT_FLOOR = _guard(
    "moment_floor", 1e-19, 0.0,
    unit="loss per unit", where="kernels/adam.py",
    reason="Gradients and first moments below this value, and second moments below its square, are set to 0: as "
    "denormal numbers, they would make the rest of the update take 3.5 times as long (docs/stability.md).",
    counted="gradient components in a step",
)  # fmt: skip

# Frame 0.

QUATERNION_FLOOR = _guard(
    "quaternion_floor", 1e-30, -1.0,
    unit="1", where="kernels/activation.py",
    reason="A quaternion with at most this squared norm counts as the identity: it has no direction and gets no "
    "gradient.",
    counted="Gaussians in an activation",
)  # fmt: skip
LEFT_OUT = _guard(
    "left_out_of_hierarchy", 0.0, NAN,
    unit="–", where="structure/hierarchy.py",
    reason="A moving Gaussian with a non-finite position belongs to no cluster and stays in place: K-means would "
    "reject the whole input.",
    counted="Gaussians in a clustering",
)  # fmt: skip

# Conventions, which always act.

ALPHA_FLOOR = _convention(
    "alpha_floor", 1.0 / 255.0, 1e-8,
    unit="1", where="engines/limits.py",
    reason="A Gaussian covers exactly the pixels where its alpha is at least this value; 8-bit images cannot represent "
    "less.",
    counted="limits the support of every Gaussian",
)  # fmt: skip
ALPHA_CAP = _convention(
    "alpha_cap", 0.99, 1.0,
    unit="1", where="engines/limits.py",
    reason="No single Gaussian is fully opaque: 1/(1 − alpha) in the backward pass is at most 100.",
    counted="acts at the centre of every opaque Gaussian",
)  # fmt: skip
TRANSMITTANCE_STOP = _convention(
    "transmittance_stop", 1e-4, 0.0,
    unit="1", where="engines/limits.py",
    reason="A pixel is complete once its transmittance would fall below this value, so it never becomes denormal.",
    counted="acts at every opaque pixel",
)  # fmt: skip
LOW_PASS = _convention(
    "low_pass", 0.3, 0.0,
    unit="pixels²", where="engines/limits.py",
    reason="Added to the diagonal of the projected covariance: each Gaussian is then at least a pixel wide, and its "
    "covariance is positive definite for any factor.",
    counted="added to every Gaussian",
)  # fmt: skip
NEAR = _convention(
    "near", 0.01, -INFINITY,
    unit="m", where="engines/limits.py",
    reason="Gaussians nearer than this are not rendered: the projection has a pole at depth 0.",
    counted="culls in every image, like the image borders",
)  # fmt: skip
TANGENT_MARGIN = _convention(
    "tangent_margin", 0.3, 1e9,
    unit="half the image size", where="engines/limits.py",
    reason="Margin around the image beyond which x/z and y/z are clamped in the projection's Jacobian: at 89° off the "
    "axis, the linearized footprint would otherwise cover the image.",
    counted="acts on every Gaussian beyond the margin",
)  # fmt: skip
COVER_SLACK = _convention(
    "cover_slack", 1e-4, 0.0,
    unit="1 and σ²", where="kernels/tiles.py",
    reason="Relative and absolute widening of the support used to cull tiles and blocks: rounding must not cull what "
    "blending would draw. It does not change any pixel.",
    counted="widens every support",
)  # fmt: skip
ROOT_FLOOR = _convention(
    "root_floor", 1e-20, 0.0,
    unit="m²", where="kernels/neighbour_terms.py, engines/torch/losses.py",
    reason="Added under the square roots of the neighbour terms, as in Dynamic3DGaussians: where nothing has moved, "
    "the gradient is then 0 instead of NaN.",
    counted="part of every pair's term",
)  # fmt: skip
ADAM_EPSILON = _convention(
    "adam_epsilon", 1e-15, 0.0,
    unit="loss per unit", where="kernels/adam.py",
    reason="Adam's epsilon, as in Dynamic3DGaussians: gradients of single Gaussians are far below the usual 1e-8.",
    counted="part of every step",
)  # fmt: skip
SSIM_C1 = _convention(
    "ssim_c1", 0.01**2, 0.0,
    unit="1", where="kernels/image_loss.py, engines/torch/losses.py",
    reason="SSIM constant (Wang et al. 2004): two black means compare as equal.",
    counted="part of every window",
)  # fmt: skip
SSIM_C2 = _convention(
    "ssim_c2", 0.03**2, 0.0,
    unit="1", where="kernels/image_loss.py, engines/torch/losses.py",
    reason="SSIM constant: two flat windows compare as equal.",
    counted="part of every window",
)  # fmt: skip
SMALLEST_SQUARE = _convention(
    "smallest_square", 1e-9, 0.0,
    unit="1", where="engines/torch/losses.py, engines/renderer.py",
    reason="Sum of squared differences below which two images count as equal: PSNR then stays finite.",
    counted="affects a reported figure, not the state",
)  # fmt: skip


class GuardCounts(Mapping[str, int]):
    """Number of times that each guard has acted since the last ``reset``.

    Args:
        names: names of the guards and of the observed events (``OBSERVED``) to count.

    >>> counts = GuardCounts("gradient_ceiling", "moment_floor")
    >>> counts.add(("gradient_ceiling", "moment_floor"), np.array([[2, 0], [1, 5]]))  # from two tasks
    >>> dict(counts)
    {'gradient_ceiling': 3, 'moment_floor': 5}
    """

    def __init__(self, *names: str) -> None:
        unknown = set(names) - set(GUARDS) - set(OBSERVED)
        if unknown:
            raise ValueError(f"unknown guards {sorted(unknown)}; scas4d_core/guards.py lists all guards")
        self._counts = dict.fromkeys(names, 0)

    def add(self, names: Sequence[str], guard_counts: NDArray[np.int64]) -> None:
        """Adds the counts returned by a kernel.

        Args:
            names: names of the counted guards and events.
            guard_counts: counts, [tasks, names] or [names].
        """
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
    "folded": "Gaussians in the forward pass of a layer at which the cluster map turns space inside out (det J ≤ 0). "
    "Nothing is clamped; the state stays finite, and later steps can undo a fold.",
}
"""Events that are counted like guard actions but do not change any value."""


def summed(counts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """Returns the sum of several mappings from names to counts."""
    total: dict[str, int] = {}
    for each in counts:
        for name, count in each.items():
            total[name] = total.get(name, 0) + count
    return total
