"""D_t on the CPU: the parameters of one frame's deformation, and the fused kernels that apply and differentiate it.

Twin: ``deformation``. Buffers are allocated once per hierarchy.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scas4d_core.gaussians import Gaussians
from scas4d_core.hierarchy import Hierarchy
from scas4d_core.kernels import cascade, deltas, neighbour_terms
from scas4d_core.neighbours import Neighbours

Array = NDArray[np.float32]


class CpuDeformation:
    """The cascade of a hierarchy, what each Gaussian adds, and the terms that tie neighbours together.

    Attributes:
        clusters: per layer [K, 10], columns r, t, c, s. deltas: [M, 9], columns Δp, Δr, Δs.
        cluster_gradients, delta_gradients: the same shapes, filled by ``backward``.
        means [N, 3], factors [N, 3, 3]: of all Gaussians, filled by ``forward``.
        turns: [M, 4], rotation since the frame before, filled by ``forward``.
        excess: [M] metres, how much the axes of each exceed their bounds, filled by ``backward``.
    """

    def __init__(
        self,
        hierarchy: Hierarchy,
        neighbours: Neighbours | None,
        bounds: Array,
        cluster_map: Literal["centred", "published"],
    ) -> None:
        self.hierarchy = hierarchy
        self.neighbours = neighbours
        self._bounds = bounds
        self._about_origin = np.float32(cluster_map == "published")
        count = len(hierarchy.rows)
        self.clusters = [np.zeros((size, cascade.PARAMETERS), np.float32) for size in hierarchy.sizes]
        self.cluster_gradients = [np.zeros_like(values) for values in self.clusters]
        self._tables = [np.zeros((size, cascade.TABLE), np.float32) for size in hierarchy.sizes]
        self.deltas = np.zeros((count, 9), np.float32)
        self.delta_gradients = np.zeros_like(self.deltas)
        layers = len(hierarchy.sizes)
        self._points = np.zeros((layers + 1, count, 3), np.float32)
        self._jacobians = np.zeros((layers + 1, count, 9), np.float32)
        self._jacobians[0] = np.eye(3, dtype=np.float32).ravel()
        self._rotations = np.zeros((layers + 1, count, 4), np.float32)
        self._rotations[0] = (1, 0, 0, 0)
        self._g_points, self._g_jacobians, self._g_rotations = (
            np.zeros((count, columns), np.float32) for columns in (3, 9, 4)
        )
        self._records = np.zeros((count, cascade.RECORD), np.float32)
        self._accumulators = np.zeros((neighbour_terms.TASKS, count, neighbour_terms.COLUMNS), np.float32)
        self._sums = np.zeros((neighbour_terms.TASKS, 3), np.float32)
        self._g_turns = np.zeros((count, 4), np.float32)
        self.turns = np.zeros((count, 4), np.float32)
        self.excess = np.zeros(count, np.float32)
        self.means = np.zeros((0, 3), np.float32)
        self.factors = np.zeros((0, 3, 3), np.float32)

    def start(self, previous: Gaussians) -> None:
        """Take Θ_{t−1} to deform; standing Gaussians stay as they are in it."""
        self._previous_factors = previous.factors
        self._points[0] = previous.means[self.hierarchy.rows]
        self.means = previous.means.copy()
        self.factors = previous.factors.copy()

    def forward(self) -> None:
        """Equations (5) to (7): fill ``means``, ``factors`` and ``turns``."""
        hierarchy = self.hierarchy
        for k, values in enumerate(self.clusters):
            cascade.cluster_tables(self._points[k], hierarchy.starts[k], values, self._tables[k])
            cascade.layer(
                *self._carried(k), hierarchy.labels[k], self._tables[k], self._about_origin, *self._carried(k + 1)
            )
        deltas.apply_deltas(
            *self._carried(len(self.clusters)), self.deltas, hierarchy.rows, self._previous_factors,
            self.means, self.factors, self.turns,
        )  # fmt: skip

    def neighbour_losses(self, sample: NDArray[np.int64], weights: tuple[float, float, float], g_means: Array) -> Array:
        """Means over the sampled pairs of rigidity, isometry and rotation; their gradients are kept and added.

        Args:
            sample: [S] entries of the hierarchy's order. weights: of the three terms.
            g_means: [N, 3], added to. The turns' gradient is kept for ``backward``.
        """
        if self.neighbours is None or len(sample) == 0:
            self._g_turns[:] = 0
            return np.zeros(3, np.float32)
        pairs = max(1, len(sample) * self.neighbours.index.shape[1])
        neighbour_terms.neighbour_terms(
            self._gathered_means(), self.turns, self._points[0], sample, self.neighbours.index,
            self.neighbours.weights, self.neighbours.distances, np.array(weights, np.float32) / np.float32(pairs),
            self._accumulators, self._sums,
        )  # fmt: skip
        neighbour_terms.gather_terms(self._accumulators, self.hierarchy.rows, g_means, self._g_turns)
        means: Array = self._sums.sum(axis=0) / pairs
        return means

    def _gathered_means(self) -> Array:
        """[M, 3] the moved means in the hierarchy's order."""
        return np.take(self.means, self.hierarchy.rows, axis=0)

    def backward(self, g_means: Array, g_factors: Array, scale_weight: float) -> float:
        """Fill ``cluster_gradients`` and ``delta_gradients``; returns the scale loss (metres, mean over axes).

        Args:
            g_means [N, 3], g_factors [N, 3, 3]: gradients of what ``forward`` filled.
        """
        hierarchy = self.hierarchy
        axes = max(1, 3 * len(hierarchy.rows))
        deltas.apply_deltas_backward(
            *self._carried(len(self.clusters)), self.deltas, hierarchy.rows, self._previous_factors,
            np.float32(scale_weight / axes), self._bounds, g_means, g_factors, self._g_turns,
            self._g_points, self._g_jacobians, self._g_rotations, self.delta_gradients, self.excess,
        )  # fmt: skip
        for k in reversed(range(len(self.clusters))):
            cascade.layer_backward(
                *self._carried(k), hierarchy.labels[k], self._tables[k], self._about_origin,
                self._g_points, self._g_jacobians, self._g_rotations, self._records,
            )  # fmt: skip
            cascade.cluster_gradients(
                self._records, hierarchy.starts[k], self.clusters[k], self._tables[k], self.cluster_gradients[k]
            )
        return float(self.excess.sum(dtype=np.float64)) / axes

    def _carried(self, layer: int) -> tuple[Array, Array, Array]:
        """Points, Jacobians and rotations as they enter a layer."""
        return self._points[layer], self._jacobians[layer], self._rotations[layer]
