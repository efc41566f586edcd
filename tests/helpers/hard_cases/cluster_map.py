"""Hard cases for deformations: saturated factors, folds, half turns, and clusters with one Gaussian or none."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from hard_cases.case import CPU, REFERENCE, BackendResult, HardCase
from hard_cases.deforming import Deforming
from scas4d_core.kernels.cascade import PARAMETERS

COUNT, COARSE, FINE = 120, 3, 12


def ordinary(count: int = COUNT, sizes: tuple[int, ...] = (COARSE, FINE), move: float = 0.05) -> Deforming:
    """Creates a cloud 1 m wide in nested clusters of similar size. All deformations are near the identity."""
    rng = np.random.default_rng(count)
    means = rng.uniform(-0.5, 0.5, (count, 3))
    fine = np.arange(count) * sizes[-1] // count if sizes else np.zeros(count)
    labels = [(fine * size // sizes[-1]).astype(np.int32) for size in sizes]
    # The clusters lie side by side along x, so that they are compact like K-means clusters.
    means[:, 0] = np.sort(means[:, 0])
    return Deforming(
        means.astype(np.float32),
        (0.02 * np.linalg.qr(rng.normal(size=(count, 3, 3)))[0] * rng.uniform(0.5, 2, (count, 1, 3))).astype("f"),
        labels,
        [(move * rng.normal(size=(size, PARAMETERS))).astype(np.float32) for size in sizes],
        (0.2 * move * rng.normal(size=(count, 9))).astype(np.float32),
        bad=np.zeros(count, bool),
    )


def first_cluster(column: slice | int, to: Any, **changes: Any) -> Deforming:
    """Creates an ordinary case in which parameters of the finest layer's first cluster are replaced.

    Args:
        column: columns of the parameters to replace.
        to: new values.
        changes: other fields of the case to replace.
    """
    made = ordinary()
    made.clusters[-1][0, column] = to
    return replace(made, **changes)


R, T, C, S = slice(0, 3), slice(3, 6), slice(6, 9), 9


def members(made: Deforming) -> int:
    """Returns the number of Gaussians in the first cluster of the finest layer."""
    return int(np.count_nonzero(made.labels[-1] == 0))


def _saturated(exponent: float) -> Deforming:
    clamped = 2 * abs(exponent) > 87
    made = first_cluster(slice(6, 10), (0, 0, 0, exponent))
    return replace(made, guards={"exponent": members(made)} if clamped else {}, gradient=5e-3)


def _alive(problem: Deforming, outcomes: Mapping[str, BackendResult]) -> list[str]:
    """Checks that factors and gradients are nonzero before the clamp, so that a shrunk cluster can grow again."""
    exponent = float(problem.clusters[-1][0, S])
    rows = problem.labels[-1] == 0
    faults = []
    for backend, outcome in outcomes.items():
        if -40 <= exponent < 0 and not np.abs(outcome.values["factors"][rows]).max() > 0:
            faults.append(f"{backend}: the factors are 0")
        if -40 <= exponent < 0 and not abs(outcome.gradients["layer 1"][0, S]) > 0:
            faults.append(f"{backend}: the gradient of s is 0")
    return faults


def _fold(strength: float) -> Deforming:
    """Creates one cluster in which c·y ranges from −strength to strength. The map folds if strength exceeds 1."""
    rng = np.random.default_rng(8)
    made = ordinary(64, (1,), 0.0)
    means = rng.uniform(-1, 1, (64, 3)).astype(np.float32)
    # 1 / (1 + x) has its pole where the determinant changes sign, so rotations are steep around it.
    made.clusters[0][0] = (0.1, -0.2, 0.05, 0, 0, 0, strength, 0.1 * strength, 0, 0)
    return replace(made, means=means, guards=None, turn=5e-2, gradient=5e-2, bound=1e7)


def _folds_are_counted(problem: Deforming, outcomes: Mapping[str, BackendResult]) -> list[str]:
    """Checks that the number of counted folds is within 1 of the number of negative determinants in float64."""
    before, after = problem.factors.astype(np.float64), outcomes[REFERENCE].values["factors"]
    folded = int(np.count_nonzero(np.linalg.det(before) * np.linalg.det(after) < 0))
    counted = outcomes[CPU].guards["folded"]
    return [] if abs(counted - folded) <= 1 else [f"counted {counted} folds, but {folded} determinants are negative"]


def _straight_back(steepness: float) -> Deforming:
    """Creates a map that folds along c, which is a half turn without a defined plane.

    With a steepness of 2, the cosine of the rotation is also 0.
    """
    made = ordinary(2, (1,), 0.0)
    means = np.array([[-1, 0, 0], [1, 0, 0]], np.float32)
    made.clusters[0][0, C] = (steepness, 0, 0)
    # f = 2σ(2z) also depends on c·y; s sets z of the folded Gaussian to 0, where f = 1 and the cosine is 2 − steepness.
    made.clusters[0][0, S] = steepness
    return replace(
        made, means=means, deltas=np.zeros_like(made.deltas), turn=None, gradient=None, guards=None, bound=1e13
    )


def _half_turn_counted(problem: Deforming, outcomes: Mapping[str, BackendResult]) -> list[str]:
    acted = outcomes[CPU].guards["half_turn"]
    return [] if acted == 1 else [f"the half turn was counted {acted} times instead of once"]


def _turned(r: float) -> Deforming:
    return first_cluster(R, (r, 0, 0), gradient=5e-3)


def _own_turn(r: float) -> Deforming:
    made = ordinary()
    made.deltas[::7, 3:6] = (0, r, 0)
    return replace(made, gradient=5e-3)


def _through_a_half_turn(sign: float) -> Deforming:
    """Creates two layers that rotate by 100° each, so that their product exceeds 180° but must still have w ≥ 0."""
    made = ordinary()
    angle = np.tan(np.radians(50.0) * sign)
    for clusters in made.clusters:
        clusters[:, R] = (0, 0, angle)
    return replace(made, gradient=5e-3)


def _stretch(exponent: float) -> Deforming:
    made = ordinary()
    made.deltas[::10, 6] = exponent
    clamped = len(made.deltas[::10]) if abs(exponent) > 87 else 0
    return replace(
        made, guards={"exponent": clamped}, gradient=None if exponent > 20 else 5e-3, bound=1e40,
        value=None if abs(exponent) > 87 else 1e-5,
    )  # fmt: skip


def _identity(count: int) -> Deforming:
    made = ordinary(count, (min(count, 3),), 0.0)
    # The neighbour terms have their kink here, so their gradients are rounding noise, but small.
    return replace(made, deltas=np.zeros_like(made.deltas), gradient=None, bound=1e3)


def _same_bits(problem: Deforming, outcomes: Mapping[str, BackendResult]) -> list[str]:
    moved = np.abs(outcomes[CPU].values["means"] - problem.means).max()
    changed = np.abs(outcomes[CPU].values["factors"] - problem.factors).max()
    turned = np.abs(outcomes[CPU].values["turns"] - (1, 0, 0, 0)).max()
    return [] if moved == changed == turned == 0 else [
        f"the identity changes means by {moved:.2g} m, factors by {changed:.2g}, rotations by {turned:.2g}"
    ]  # fmt: skip


def _of_one(sizes: tuple[int, ...]) -> Deforming:
    return ordinary(sizes[-1], sizes)


def _unbalanced(count: int) -> Deforming:
    """Creates one cluster with nearly all Gaussians, and ten clusters with one Gaussian each."""
    made = ordinary(count, (1, 11))
    labels = np.maximum(0, np.arange(count) - (count - 11)).astype(np.int32)
    return replace(made, labels=[np.zeros(count, np.int32), labels])


def _place(metres: float) -> Deforming:
    """Moves the cloud far from the internal origin, where the resolution of float32 is about 6e-8 of the distance."""
    made = ordinary()
    # Pivots and offsets are differences of large numbers: tolerance is the float spacing times the number of layers.
    spacing = max(1e-5, 1e-6 * metres)
    return replace(
        made, means=(made.means + np.float32(metres)).astype(np.float32), value=spacing, turn=max(1e-4, spacing),
        gradient=max(2e-3, 100 * spacing),
    )  # fmt: skip


def _size(metres: float) -> Deforming:
    """Scales the cloud, its Gaussians and its displacements by ``metres``, and c by the inverse."""
    made = ordinary()
    for clusters in made.clusters:
        clusters[:, T] *= metres
        clusters[:, C] /= metres
    made.deltas[:, :3] *= metres
    return replace(
        made,
        means=metres * made.means,
        factors=metres * made.factors,
        value=1e-5 * max(metres, 1),
        bound=1e6 * max(metres, 1),
    )


def _coincident(count: int) -> Deforming:
    made = ordinary(count, (2,))
    return replace(made, means=np.full_like(made.means, 0.3))


def _collinear(count: int) -> Deforming:
    made = ordinary(count, (4,))
    return replace(made, means=(np.linspace(-1, 1, count)[:, None] * np.array([1, 0, 0])).astype(np.float32))


def _not_finite(value: float, what: str = "means", count: int = 3) -> Deforming:
    made = ordinary()
    rows = np.random.default_rng(9).choice(COUNT, count, replace=False)
    getattr(made, what)[rows] = value
    made.bad[rows] = True
    return replace(made, guards={"held_back": count})


def _apart(problem: Deforming, outcomes: Mapping[str, BackendResult]) -> list[str]:
    """Checks that the gradients of rows that are held back are 0 with respect to their own parameters."""
    own = outcomes[CPU].gradients["own"][problem.bad]
    return [] if np.all(own == 0) else ["cpu: a row that is held back has a nonzero gradient"]


def _empty(count: int) -> Deforming:
    """Makes every Gaussian of ``count`` clusters of the finest layer invalid."""
    made = ordinary()
    made.bad[:] = made.labels[-1] < count
    made.means[made.bad] = np.nan
    return replace(made, guards={"held_back": int(made.bad.sum()), "empty_cluster": count + count * COARSE // FINE})


def _all_bad(count: int) -> Deforming:
    made = ordinary(count, (2,))
    return replace(
        made, means=np.full_like(made.means, np.nan), bad=np.ones(count, bool),
        guards={"held_back": count, "empty_cluster": 2},
    )  # fmt: skip


def _mirrored(count: int) -> Deforming:
    made = ordinary()
    made.factors[:count, :, 0] *= -1
    return made


def _flat(thinness: float) -> Deforming:
    made = ordinary()
    made.factors[:, :, 2] *= np.float32(thinness)
    return made


def _published(s: float) -> Deforming:
    made = first_cluster(S, s)
    return replace(made, kind="published")


def _still(problem: Deforming, outcomes: Mapping[str, BackendResult]) -> list[str]:
    worst = max(float(np.abs(o.values["terms"]).max()) for o in outcomes.values())
    return [] if worst < 1e-6 else [f"a neighbour term is {worst:.2g} although nothing moves"]


CASES = (
    HardCase(
        "identity",
        "number of Gaussians, with all parameters 0; no bit changes, rotations are the identity, neighbour terms are 0",
        "equation (6)",
        (1, 16, 17, 200),
        _identity,
        lambda p, o: _same_bits(p, o) + _still(p, o),
    ),
    HardCase(
        "factor near 0",
        "s of a cluster; tanh(s) + 1 is 0 in float32 below −9, but our formula is not; clamped below −43.5",
        "equation (6) in float32",
        (-5.0, -9.0, -20.0, -40.0, -44.0, -1e4),
        _saturated,
        _alive,
    ),
    HardCase("factor near 2", "s of a cluster", "equation (6) in float32", (5.0, 9.0, 20.0, 44.0, 1e4), _saturated),
    HardCase(
        "fold",
        "maximum of c·y within a cluster; from 1 on, det J changes sign, which must stay finite and be counted",
        "det J = f³ (1 + (2 − f) cᵀ(x − p))",
        (0.5, 0.99, 1.5, 3.0, 10.0),
        _fold,
        _folds_are_counted,
    ),
    HardCase(
        "straight back",
        "negative of c·y along c; a half turn without a defined plane; at 2, the cosine is also 0",
        "polar rotation of a fold",
        (2.0, 3.0, 30.0),
        _straight_back,
        _half_turn_counted,
    ),
    HardCase(
        "large c",
        "c, per metre",
        "equation (6)",
        (10.0, 100.0, 1000.0),
        lambda c: first_cluster(C, (c, -c, c), guards=None, turn=None, gradient=None, bound=1e8),
    ),
    HardCase(
        "rotation by 180°",
        "r, the tangent of half the angle",
        "rotation parameter (1, r)",
        (1e2, 1e4, 1e8, 1e15),
        _turned,
    ),
    HardCase(
        "own rotation by 180°",
        "r of one Gaussian, the tangent of half the angle",
        "rotation parameter (1, r)",
        (1e2, 1e4, 1e8, 1e15),
        _own_turn,
    ),
    HardCase(
        "beyond a half turn",
        "two layers that rotate by 100° each, in either direction (q and −q)",
        "quaternion sign",
        (1.0, -1.0),
        _through_a_half_turn,
    ),
    HardCase(
        "stretch",
        "Δs of a tenth of the Gaussians; clamped beyond ±87, otherwise limited only at commit",
        "gsplat#613",
        (-100.0, -60.0, 20.0, 60.0, 100.0),
        _stretch,
    ),
    HardCase(
        "cluster of one",
        "clusters per layer; each cluster of the finest layer contains one Gaussian",
        "small clusters",
        ((5,), (2, 40)),
        _of_one,
    ),
    HardCase(
        "unbalanced clusters",
        "number of Gaussians, nearly all in one cluster and ten in clusters of their own",
        "K-means on real scenes",
        (100, 5000),
        _unbalanced,
    ),
    HardCase(
        "empty cluster", "number of clusters that contain only NaN Gaussians", "after losses", (1, 4), _empty, _apart
    ),
    HardCase("every Gaussian NaN", "number of Gaussians", "gsplat#248", (4, 40), _all_bad),
    HardCase(
        "NaN in a cluster",
        "number of NaN means",
        "gsplat#248, vye16/shape-of-motion#43",
        (1, 3, 30),
        lambda n: _not_finite(np.nan, count=n),
        _apart,
    ),
    HardCase(
        "infinity in a cluster", "value of the infinite means", "gsplat#248", (np.inf, -np.inf), _not_finite, _apart
    ),
    HardCase(
        "NaN factor in a cluster",
        "value of the non-finite factors",
        "graphdeco-inria/gaussian-splatting#781",
        (np.nan, np.inf),
        lambda v: _not_finite(v, "factors"),
        _apart,
    ),
    HardCase("all in one place", "number of Gaussians", "coincident points", (2, 40), _coincident),
    HardCase("all on one line", "number of Gaussians", "collinear points", (8, 100), _collinear),
    HardCase(
        "far from the origin",
        "distance from the origin in metres; agreement within the float32 spacing at that distance",
        "users' coordinates",
        (10.0, 1e3, 1e4),
        _place,
    ),
    HardCase("scaled cloud", "scale factor of all lengths", "users' units", (1e-6, 1e-3, 1e3), _size),
    HardCase(
        "cluster moved far away",
        "translation t in metres",
        "teleport",
        (10.0, 1e4),
        lambda t: first_cluster(T, t, value=1e-6 * max(t, 10), gradient=1e-2),
    ),
    HardCase("mirrored factors", "number of Gaussians with det F < 0", "reflections", (1, 60), _mirrored),
    HardCase("flat Gaussians", "scale of the third axis", "2D Gaussian Splatting", (1e-3, 1e-12, 0.0), _flat),
    HardCase(
        "published map",
        "s of a cluster, which is scaled about the world's origin",
        "equation (6) as printed",
        (-9.0, 0.0, 5.0),
        _published,
    ),
)
