"""Builds the neighbour graph of the rigidity terms, as in Dynamic3DGaussians.

The graph contains the k nearest neighbours of each moving Gaussian, and their weights.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree


@dataclass(frozen=True, eq=False)
class Neighbours:
    """Neighbour graph over M moving Gaussians, in the order of ``Hierarchy.rows``.

    Attributes:
        index: [M, k] int32 indices of the neighbours of each Gaussian, 0 for missing neighbours.
        weights: [M, k] float32 weights exp(−falloff d²), 0 for missing neighbours.
        distances: [M, k] float32 distances in metres at the time when the graph was built, 0 for
            missing neighbours.
    """

    index: NDArray[np.int32]
    weights: NDArray[np.float32]
    distances: NDArray[np.float32]


def build_neighbours(means: NDArray[Any], count: int, falloff: float) -> Neighbours:
    """Returns the graph of the ``count`` nearest neighbours of each Gaussian.

    If there are fewer other Gaussians, all of them are neighbours.

    Args:
        means: [M, 3] positions in metres.
        count: number of neighbours k.
        falloff: decay of the weights in 1/m²; a neighbour at distance d has the weight exp(−falloff d²).

    >>> graph = build_neighbours(np.array([[0, 0, 0], [1, 0, 0], [3, 0, 0]]), count=1, falloff=1.0)
    >>> graph.index[:, 0], graph.distances[:, 0]
    (array([1, 0, 1], dtype=int32), array([1., 1., 2.], dtype=float32))
    >>> graph.weights[:, 0].round(3)
    array([0.368, 0.368, 0.018], dtype=float32)
    """
    points = np.asarray(means, dtype=np.float64)
    total = len(points)
    neighbour_count = min(count, total - 1)
    index = np.zeros((total, count), np.int32)
    weights = np.zeros((total, count), np.float32)
    distances = np.zeros((total, count), np.float32)
    if neighbour_count > 0:
        far, near = (np.asarray(found_by) for found_by in cKDTree(points).query(points, k=neighbour_count + 1))
        # The query usually returns the point itself first. If several points coincide, the point
        # itself may be at any position, or missing; in that case, the farthest point is removed.
        own = near == np.arange(total)[:, None]
        own[~own.any(axis=1), -1] = True
        near, far = near[~own].reshape(total, neighbour_count), far[~own].reshape(total, neighbour_count)
        index[:, :neighbour_count] = near
        distances[:, :neighbour_count] = far
        weights[:, :neighbour_count] = np.exp(-falloff * far**2)
    return Neighbours(index, weights, distances)
