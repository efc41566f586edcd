"""Selects the Gaussians that carry a point, and combines their predictions of its position. Requires only NumPy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scas4d_core.gaussians import Gaussians

Float = NDArray[np.float64]

WEISZFELD_ROUNDS = 12
"""Number of iterations for the geometric median. Further ones change it by a small fraction of the carriers' spread."""
BYTES_AT_ONCE = 64e6
"""Working memory limit for the carrier search, in bytes."""
ABSENT = -1e9
"""Log opacity assigned to retired Gaussians, so that they carry no points."""
MIN_PRESENT_WEIGHT = 0.05
"""Minimum total weight of a point's present carriers. A few distant carriers cannot determine the point's position."""


def carriers(
    gaussians: Gaussians, points: Float, count: int, softening: float
) -> tuple[NDArray[np.intp], Float, Float]:
    """Returns the Gaussians that carry each point: those with the largest o·exp(−½ m²).

    Here, o is the opacity and m the Mahalanobis distance of the point.

    Args:
        gaussians: state of N Gaussians.
        points: [Q, 3] points in the internal world, in metres.
        count: number K of Gaussians that carry each point; limited to N.
        softening: length in metres added in quadrature to the axes of each Gaussian to compute m.

    Returns:
        A tuple of three arrays:

        - The rows of the carriers, [Q, K], largest weight first.
        - The weights of the carriers, [Q, K], which are proportional to o·exp(−½ m²) and sum to 1 for each point. Far
          from all Gaussians, only the nearest one has a significant weight.
        - The combined opacity of the K carriers at each point, [Q], which is 1 − Π(1 − o·exp(−½ m²)).

    >>> state = Gaussians.of_points([[0, 0, 0], [1, 0, 0]], radius=0.2)
    >>> rows, weights, opacity = carriers(state, np.array([[0.1, 0, 0]]), count=1, softening=0.0)
    >>> rows, opacity.round(2)
    (array([[0]]), array([0.79]))
    """
    count = min(count, len(gaussians))
    factors = gaussians.factors.astype(np.float64)
    covariance = factors @ factors.transpose(0, 2, 1)
    covariance += (softening**2 + 1e-12) * np.eye(3)
    whiten = np.linalg.cholesky(np.linalg.inv(covariance)).transpose(0, 2, 1)  # m² = |whiten (p − μ)|²
    whitened_means = np.einsum("nij,nj->ni", whiten, gaussians.means)[:, :, None]
    log_opacity = np.log(np.maximum(gaussians.opacities.astype(np.float64), 1e-12))
    log_opacity[gaussians.retired] = ABSENT

    rows = np.empty((len(points), count), dtype=np.intp)
    logs = np.empty((len(points), count))
    step = max(1, int(BYTES_AT_ONCE / (48 * len(gaussians))))
    for start in range(0, len(points), step):
        part = points[start : start + step]
        whitened = (whiten.reshape(-1, 3) @ part.T).reshape(len(gaussians), 3, len(part))
        score = (log_opacity[:, None] - 0.5 * np.square(whitened - whitened_means).sum(axis=1)).T
        best = np.argpartition(-score, count - 1, axis=1)[:, :count]
        best = np.take_along_axis(best, np.argsort(-np.take_along_axis(score, best, 1), axis=1, kind="stable"), 1)
        rows[start : start + step] = best
        logs[start : start + step] = np.take_along_axis(score, best, 1)
    weights = np.exp(logs - logs[:, :1])
    weights /= weights.sum(axis=1, keepdims=True)
    covered = 1 - np.prod(1 - np.exp(logs), axis=1)
    return rows, weights, covered


def geometric_median(points: Float, weights: Float) -> Float:
    """Returns the geometric median [Q, 3] of each row of K points, computed by Weiszfeld's algorithm.

    Args:
        points: [Q, K, 3] points.
        weights: [Q, K] weights; each row sums to 1.

    >>> points = np.array([[[0, 0, 0], [0.1, 0, 0], [9, 9, 9]]])
    >>> bool(np.linalg.norm(geometric_median(points, np.full((1, 3), 1 / 3))) < 0.2)  # the outlier is ignored
    True
    """
    centre: Float = np.einsum("qk,qki->qi", weights, points)
    if points.shape[1] < 3:
        return centre  # any point between two points is a median
    for _ in range(WEISZFELD_ROUNDS):
        distance = np.linalg.norm(points - centre[:, None], axis=-1)
        pull = weights / np.maximum(distance, 1e-9)
        centre = np.einsum("qk,qki->qi", pull, points) / pull.sum(axis=1, keepdims=True)
    return centre


def drop_absent(answers: Float, weights: Float, there: NDArray[np.bool_]) -> tuple[Float, Float, NDArray[np.bool_]]:
    """Excludes absent carriers from the predicted positions of points.

    Args:
        answers: [Q, K, 3] position predicted by each carrier.
        weights: [Q, K] weight of each carrier.
        there: [Q, K] whether each carrier is present.

    Returns:
        The positions [Q, K, 3], with zeros for absent carriers; the weights [Q, K] of the remaining carriers, which sum
        to 1; and whether the remaining carriers had more than ``MIN_PRESENT_WEIGHT`` of the weight, [Q].
    """
    if there.all():
        return answers, weights, np.ones(len(answers), np.bool_)
    shares = np.where(there, weights, 0)
    total = shares.sum(axis=1)
    some: NDArray[np.bool_] = total > MIN_PRESENT_WEIGHT
    shares = np.where(some[:, None], shares / np.where(some, total, 1)[:, None], weights)
    return np.where(there[..., None], answers, 0), shares, some
