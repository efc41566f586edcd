"""Neighbour graph of the rigidity terms, as in Dynamic3DGaussians.

The graph contains the k nearest neighbours of each moving Gaussian, and their weights.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree


@dataclass(frozen=True, eq=False)
class Neighbours:
    """Neighbour graph over M moving Gaussians, in the order of ``Hierarchy.rows``.

    The host only searches the neighbours if an engine reads them, which an engine on a GPU does not.

    Args:
        means: [M, 3] positions in metres.
        count: number of neighbours k. If there are fewer other Gaussians, all of them are neighbours.
        falloff: decay of the weights in 1/m²; a neighbour at distance d has the weight exp(−falloff d²).

    >>> graph = Neighbours(np.array([[0, 0, 0], [1, 0, 0], [3, 0, 0]]), count=1, falloff=1.0)
    >>> graph.index[:, 0], graph.distances[:, 0]
    (array([1, 0, 1], dtype=int32), array([1., 1., 2.], dtype=float32))
    >>> graph.weights[:, 0].round(3)
    array([0.368, 0.368, 0.018], dtype=float32)
    """

    means: NDArray[Any]
    count: int
    falloff: float

    @cached_property
    def _nearest(self) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.bool_]]:
        """[M, k] indices and distances in ascending order, and which of the k columns are used."""
        points = np.asarray(self.means, dtype=np.float64)
        total = len(points)
        neighbour_count = min(self.count, total - 1)
        index, distances = np.zeros((total, self.count), np.int32), np.zeros((total, self.count))
        if neighbour_count > 0:
            far, near = (np.asarray(found_by) for found_by in cKDTree(points).query(points, k=neighbour_count + 1))
            # The query usually returns the point itself first. If several points coincide, the point
            # itself may be at any position, or missing; in that case, the farthest point is removed.
            own = near == np.arange(total)[:, None]
            own[~own.any(axis=1), -1] = True
            index[:, :neighbour_count] = near[~own].reshape(total, neighbour_count)
            distances[:, :neighbour_count] = far[~own].reshape(total, neighbour_count)
        return index, distances, np.arange(self.count) < neighbour_count

    @property
    def index(self) -> NDArray[np.int32]:
        """[M, k] neighbours of each Gaussian in ascending order of their distance, 0 for missing neighbours."""
        return self._nearest[0]

    @cached_property
    def distances(self) -> NDArray[np.float32]:
        """[M, k] distances in metres, 0 for missing neighbours."""
        return self._nearest[1].astype(np.float32)

    @cached_property
    def weights(self) -> NDArray[np.float32]:
        """[M, k] weights exp(−falloff d²), 0 for missing neighbours."""
        _, distances, used = self._nearest
        weights: NDArray[np.float32] = np.where(used, np.exp(-self.falloff * distances**2), 0).astype(np.float32)
        return weights
