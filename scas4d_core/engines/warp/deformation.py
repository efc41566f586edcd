"""Deformation of an update on the device: cascade, deltas and loss terms, with forward and backward pass."""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray

from scas4d_core.engines.cpu.gloss import without_turn
from scas4d_core.engines.engine import StepScalars, Tables
from scas4d_core.engines.plan import Structure, UpdatePlan
from scas4d_core.engines.warp import cluster_map, gaussian_deltas
from scas4d_core.engines.warp.lanes import lanes_of
from scas4d_core.engines.warp.neighbour_terms import neighbour_terms
from scas4d_core.gaussians import Gaussians

Array = NDArray[np.float32]


class WarpDeformation:
    """The parameters of a deformation, the deformed Gaussians, and the gradients of both.

    Args:
        device: Warp device, such as "cpu" or "cuda:0". plan, structure: those of the updates.

    Attributes:
        clusters: [K, 10] per layer, columns r, t, c, s of equation (6). deltas: [M, 9], columns Δp, Δr, Δs.
        cluster_gradients, delta_gradients: gradients of the same shapes, filled by ``backward``.
        means, factors: [N] of vec3 and mat33, all Gaussians, filled by ``forward``.
        turns: [M] of vec4 (w, x, y, z), rotation since Θ_{t−1}, filled by ``forward``.
        loss: [1] weighted terms of the last iteration, excluding rendering losses.
        held_back: number of moving Gaussians that are not finite; they stay unchanged.
    """

    def __init__(self, device: str, plan: UpdatePlan, structure: Structure) -> None:
        hierarchy, graph = structure.hierarchy, structure.neighbours
        count = len(hierarchy.rows)
        self._device, self._plan, self._lanes = device, plan, lanes_of(device)
        self._rows = self._upload(hierarchy.rows, wp.int32)
        self._starts = [self._upload(starts, wp.int32) for starts in hierarchy.starts]
        self._moving, self._count = hierarchy.rows, count
        self.clusters = [self._zeros((size, cluster_map.COLUMNS)) for size in hierarchy.sizes]
        self.cluster_gradients = [self._zeros((size, cluster_map.COLUMNS)) for size in hierarchy.sizes]
        self._pivots = [self._zeros(size, wp.vec3) for size in hierarchy.sizes]
        self.deltas, self.delta_gradients = self._zeros((count, 9)), self._zeros((count, 9))
        stages = len(hierarchy.sizes) + 1
        self._points = [self._zeros(count, wp.vec3) for _ in range(stages)]
        self._jacobians = [self._zeros(count, wp.mat33) for _ in range(stages)]
        self._turned = [self._zeros(count, wp.vec4) for _ in range(stages)]
        self._jacobians[0].assign(np.tile(np.eye(3, dtype=np.float32), (count, 1, 1)))
        self._turned[0].assign(without_turn(count))
        self._g_points, self._g_jacobians = self._zeros(count, wp.vec3), self._zeros(count, wp.mat33)
        self._g_turned = self._zeros(count, wp.vec4)
        self._tied_means, self._tied_turns = self._zeros(count, wp.vec3), self._zeros(count, wp.vec4)
        self._bounds = self._upload(structure.length_bounds, wp.vec3)
        self._graph = graph
        if graph is not None:
            self._neighbours = self._upload(graph.index, wp.int32, 2)
            self._distances = self._upload(graph.distances, wp.float32, 2)
            self._pair_weights = self._upload(graph.weights, wp.float32, 2)
        self._published = int(plan.cluster_map == "published")
        self._terms = gaussian_deltas.Terms()
        self._terms.separate = int(plan.covariance == "separate")
        self._terms.axis_length = plan.axis_length / max(3 * count, 1)
        if plan.floor is not None:
            self._terms.floor = plan.floor_weight / max(count, 1)
            self._terms.plane = wp.vec4(*plan.floor)
        self.turns = self._zeros(count, wp.vec4)
        self.loss = self._zeros(1)
        self.held_back = 0
        self._samples: list[wp.array] = []

    def _zeros(self, shape: int | tuple[int, ...], dtype: object = wp.float32) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=self._device)

    def _upload(self, values: NDArray[np.generic], dtype: object, dimensions: int = 1) -> wp.array:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, ndim=dimensions, device=self._device)

    def start(self, previous: Gaussians) -> None:
        """Loads the initial state Θ_{t−1} of an attempt."""
        moving = self._moving
        given = np.concatenate([previous.means[moving], previous.factors[moving].reshape(-1, 9)], axis=1)
        sound: NDArray[np.bool_] = np.isfinite(given).all(axis=1)
        self.held_back = int(np.count_nonzero(~sound))
        self._sound = self._upload(sound.astype(np.int32), wp.int32)
        self._previous_means = self._upload(previous.means, wp.vec3)
        self._previous_factors = self._upload(previous.factors, wp.mat33)
        self.means, self.factors = wp.clone(self._previous_means), wp.clone(self._previous_factors)
        self._points[0].assign(previous.means[moving])
        self.turns.assign(without_turn(self._count))
        if self._graph is not None:
            pairs = sound[:, None] & sound[self._graph.index]
            self._pair_weights.assign(np.where(pairs, self._graph.weights, np.float32(0)))

    @property
    def previous(self) -> tuple[wp.array, wp.array]:
        """Returns means and factors of Θ_{t−1}, [N] of vec3 and mat33."""
        return self._previous_means, self._previous_factors

    def set_tables(self, tables: Tables) -> None:
        """Sets the parameters from host tables."""
        for table, values in zip(self.clusters, tables.clusters, strict=True):
            table.assign(values)
        self.deltas.assign(tables.deltas)

    def tables(self) -> Tables:
        """Returns the parameters as host tables; waits for the device."""
        return Tables([table.numpy().copy() for table in self.clusters], self.deltas.numpy().copy())

    def set_samples(self, samples: list[NDArray[np.int64]]) -> None:
        """Sets the samples of an attempt whose neighbours are compared."""
        self._samples = [self._upload(sample, wp.int32) for sample in samples]

    def forward(self) -> None:
        """Evaluates equations (5) to (7); fills ``means``, ``factors`` and ``turns``."""
        for layer, table in enumerate(self.clusters):
            inputs = [self._published, self._starts[layer], table, self._sound, *self._stage(layer)]
            inputs += [self._pivots[layer], *self._stage(layer + 1)]
            wp.launch(cluster_map.map_clusters, table.shape[0] * self._lanes, inputs, device=self._device)
        inputs = [self._terms, self._rows, self._sound, *self._stage(-1), self._previous_factors, self.deltas]
        inputs += [self.means, self.factors, self.turns]
        wp.launch(gaussian_deltas.apply_deltas, self._count, inputs, device=self._device)

    def _stage(self, layer: int) -> tuple[wp.array, wp.array, wp.array]:
        return self._points[layer], self._jacobians[layer], self._turned[layer]

    def backward(self, g_means: wp.array, g_factors: wp.array, step: StepScalars) -> None:
        """Fills ``delta_gradients``, ``cluster_gradients`` of the layers that are not frozen, and ``loss``.

        Args:
            g_means, g_factors: [N] of vec3 and mat33, gradients of the rendering losses.
        """
        plan, device = self._plan, self._device
        for array in (self.loss, self._tied_means, self._tied_turns):
            array.zero_()
        if plan.neighbour_terms and self._graph is not None:
            sample = self._samples[step.sample]
            pairs = max(1, sample.shape[0] * self._graph.index.shape[1])
            weights = wp.vec3(step.rigidity / pairs, plan.isometry / pairs, plan.rotation / pairs)
            graph = [self._neighbours, self._pair_weights, self._distances]
            inputs = [weights, sample, *graph, self._rows, self._previous_means, self.means, self.turns]
            inputs += [self._tied_means, self._tied_turns, self.loss]
            wp.launch(neighbour_terms, sample.shape[0], inputs, device=device)
        inputs = [self._terms, self._rows, self._sound, self._jacobians[-1], self._turned[-1], self._previous_factors]
        inputs += [self.deltas, self._bounds, self.means, self.factors, g_means, g_factors]
        inputs += [self._tied_means, self._tied_turns, self._g_points, self._g_jacobians, self._g_turned]
        wp.launch(
            gaussian_deltas.apply_deltas_backward, self._count, [*inputs, self.delta_gradients, self.loss],
            device=device,
        )  # fmt: skip
        for layer in reversed(range(step.frozen, len(self.clusters))):
            table = self.clusters[layer]
            inputs = [self._published, self._starts[layer], table, self._sound, *self._stage(layer)]
            inputs += [self._pivots[layer], self._g_points, self._g_jacobians, self._g_turned]
            wp.launch(
                cluster_map.map_clusters_backward, table.shape[0] * self._lanes,
                [*inputs, self.cluster_gradients[layer]], device=device,
            )  # fmt: skip
