"""Deformation on the device: cascade, per-Gaussian deltas and their loss terms, with forward and backward passes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from scas4d_core.engines.engine import AttemptStart, StepScalars, Tables
from scas4d_core.engines.plan import Structure, UpdatePlan
from scas4d_core.engines.warp import cluster_map, gaussian_deltas
from scas4d_core.engines.warp.adam import Optimizer
from scas4d_core.engines.warp.copies import DeviceCopies, structures_on, upload
from scas4d_core.engines.warp.lanes import lanes_of
from scas4d_core.engines.warp.nearest import nearest
from scas4d_core.engines.warp.neighbour_terms import neighbour_terms, weigh_pairs
from scas4d_core.engines.warp.step_records import StepRecords

TABLES = 4
"""Number of host tables whose device copies are kept: the candidates of an attempt."""


class WarpDeformation:
    """The parameters of a deformation with their optimizers, and the resulting Gaussians.

    No method waits for the device. ``forward`` and ``backward`` can be captured in a CUDA graph.

    Args:
        device: Warp device, such as "cpu" or "cuda:0".
        plan: plan of the scene's updates.
        structure: clusters and neighbour graph of the moving Gaussians.
        records: values that change between iterations. Its first optimizers are those of the layers and the deltas.

    Attributes:
        clusters: [K, 10] parameters of each layer, with columns r, t, c, s of equation (6).
        deltas: [M, 9] per-Gaussian deltas, with columns Δp, Δr, Δs.
        gradients: gradients of ``clusters``, followed by those of ``deltas``, from the last iteration.
        optimizers: optimizers for the layers, followed by the optimizer for the deltas.
        means: [N] vec3 means of all Gaussians.
        factors: [N] mat33 covariance factors of all Gaussians.
        turns: [M] vec4 rotations since Θ_{t−1}, as quaternions (w, x, y, z).
        entries: [N] index of each Gaussian among the moving ones, or −1 for static Gaussians.
        unsound: [1] number of moving Gaussians with non-finite values, which stay unchanged.
    """

    def __init__(self, device: str, plan: UpdatePlan, structure: Structure, records: StepRecords) -> None:
        hierarchy, graph, total = structure.hierarchy, structure.neighbours, len(structure.roots)
        count = len(hierarchy.rows)
        self._device, self._plan, self._lanes = device, plan, lanes_of(device)
        self._records, self._count = records, count
        copies = structures_on(device)
        self._rows = copies.of(hierarchy.rows, wp.int32)
        self._starts = [copies.of(starts, wp.int32) for starts in hierarchy.starts]
        self._lengths = copies.of(structure.first_lengths, wp.vec3)
        self.entries, points = wp.full(total, -1, dtype=wp.int32, device=device), self._zeros(count, wp.vec3)
        inputs = [self._rows, copies.of(structure.roots, wp.vec3), self.entries, points]
        wp.launch(gaussian_deltas.find_entries, count, inputs, device=device)
        self.clusters = [self._zeros((size, cluster_map.COLUMNS)) for size in hierarchy.sizes]
        self.deltas = self._zeros((count, 9))
        tables = self.parameters
        self.gradients, self._saved = ([wp.zeros_like(table) for table in tables] for _ in range(2))
        self.optimizers = [Optimizer(table.shape, records.optimizer(k)) for k, table in enumerate(tables)]
        self._pivots = [self._zeros(size, wp.vec3) for size in hierarchy.sizes]
        self._points, self._jacobians, self._turned = (
            [self._zeros(count, dtype) for _ in tables] for dtype in (wp.vec3, wp.mat33, wp.vec4)
        )
        self._jacobians[0].fill_(wp.mat33(1, 0, 0, 0, 1, 0, 0, 0, 1))
        self._g_points, self._g_jacobians = self._zeros(count, wp.vec3), self._zeros(count, wp.mat33)
        self._g_turned = self._zeros(count, wp.vec4)
        self._tied_means, self._tied_turns = self._zeros(count, wp.vec3), self._zeros(count, wp.vec4)
        self._sound, self.unsound = self._zeros(count, wp.int32), self._zeros(1, wp.int32)
        self.means, self._previous_means = self._zeros(total, wp.vec3), self._zeros(total, wp.vec3)
        self.factors, self._previous_factors = self._zeros(total, wp.mat33), self._zeros(total, wp.mat33)
        self.turns = self._zeros(count, wp.vec4)
        self._graph = graph
        if graph is not None:
            self._neighbours, squares = nearest(points, graph.count)
            self._distances, self._pair_weights = (self._zeros(squares.shape) for _ in range(2))
            inputs = [squares, graph.falloff, self._distances, self._pair_weights]
            wp.launch(weigh_pairs, squares.shape, inputs, device=device)
        self._copies = DeviceCopies(device, TABLES * len(tables))
        self._samples, self._sample_sizes = self._zeros((0, 0), wp.int32), list[int]()
        self._published = int(plan.cluster_map == "published")
        self._terms = gaussian_deltas.Terms()
        self._terms.separate = int(plan.covariance == "separate")
        self._terms.axis_length = plan.axis_length / max(3 * count, 1)
        if plan.floor is not None:
            self._terms.floor = plan.floor_weight / max(count, 1)
            self._terms.plane = wp.vec4(*plan.floor)

    def _zeros(self, shape: int | tuple[int, ...], dtype: object = wp.float32) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=self._device)

    def load_state(self, means: wp.array, factors: wp.array) -> None:
        """Loads the means ([N] vec3) and factors ([N] mat33) of Θ_{t−1}."""
        for array, values in (
            (self._previous_means, means), (self._previous_factors, factors), (self.means, means),
            (self.factors, factors),
        ):  # fmt: skip
            wp.copy(array, values)
        self.unsound.zero_()
        inputs = [self._rows, means, factors, self._sound, self._points[0], self.turns, self.unsound]
        wp.launch(gaussian_deltas.take_moving, self._count, inputs, device=self._device)
        wp.copy(self._turned[0], self.turns)

    @property
    def previous(self) -> tuple[wp.array, wp.array]:
        """Means ([N] vec3) and factors ([N] mat33) of Θ_{t−1}."""
        return self._previous_means, self._previous_factors

    def set_tables(self, tables: Tables) -> None:
        """Sets the parameters from host tables."""
        for table, values in zip(self.parameters, [*tables.clusters, tables.deltas], strict=True):
            if values.any():
                wp.copy(table, self._copies.of(values, wp.float32))
            else:  # by default, the deltas always start at 0
                table.zero_()

    @property
    def parameters(self) -> list[wp.array]:
        """Tables of all layers, followed by the deltas."""
        return [*self.clusters, self.deltas]

    def tables_of(self, values: Sequence[NDArray[Any]]) -> Tables:
        """Returns the tables whose host copies ``values`` starts with. ``set_tables`` does not upload them again."""
        for table, host in zip(self.parameters, values, strict=False):
            self._copies.store(wp.clone(table), host)
        clusters = len(self.clusters)
        return Tables(list(values[:clusters]), values[clusters])

    def begin(self, start: AttemptStart) -> bool:
        """Starts an attempt from the current parameters. ``restart`` must be called next.

        Returns:
            Whether buffers were reallocated, which invalidates captured graphs.
        """
        for table, saved in zip(self.parameters, self._saved, strict=True):
            wp.copy(saved, table)
        self._sample_sizes = [len(sample) for sample in start.samples]
        samples = np.full((len(start.samples), max(self._sample_sizes, default=0)), -1, np.int32)
        for row, sample in enumerate(start.samples):
            samples[row, : len(sample)] = sample
        replaced = bool(samples.shape != self._samples.shape)
        if replaced:
            self._samples = self._zeros(samples.shape, wp.int32)
        wp.copy(self._samples, upload(samples, wp.int32, self._device))
        return replaced

    def restart(self, start: AttemptStart) -> None:
        """Restores the parameters to their values at the start of the attempt, with zero moments."""
        betas = start.beta1, start.beta2
        for optimizer, columns in zip(self.optimizers, [*start.cluster_columns, start.delta_columns], strict=True):
            optimizer.begin(columns, betas)
        for table, saved in zip(self.parameters, self._saved, strict=True):
            wp.copy(table, saved)

    def scalars(self, step: StepScalars) -> list[float]:
        """Returns an iteration's scalars for ``StepRecords.write``: the weights, then each optimizer's scalars."""
        plan, pairs = self._plan, 1
        if self._graph is not None:
            pairs = max(1, self._sample_sizes[step.sample] * self._graph.count)
        scalars = [step.rigidity / pairs, plan.isometry / pairs, plan.rotation / pairs]
        for place, (optimizer, factor) in enumerate(zip(self.optimizers, [*step.layers, step.own], strict=True)):
            scalars += optimizer.next_scalars(0.0 if place < step.frozen else factor)
        return scalars

    def forward(self, unchanged: int = 0) -> None:
        """Evaluates equations (5) to (7) and fills ``means``, ``factors`` and ``turns``.

        Args:
            unchanged: number of layers, counted from the coarsest, that have not changed since the last call.
        """
        for layer in range(unchanged, len(self.clusters)):
            table = self.clusters[layer]
            inputs = [self._published, self._starts[layer], table, self._sound, *self._stage(layer)]
            inputs += [self._pivots[layer], *self._stage(layer + 1)]
            wp.launch(cluster_map.map_clusters, table.shape[0] * self._lanes, inputs, device=self._device)
        inputs = [self._terms, self._rows, self._sound, *self._stage(-1), self._previous_factors, self.deltas]
        inputs += [self.means, self.factors, self.turns, self._tied_means, self._tied_turns]
        wp.launch(gaussian_deltas.apply_deltas, self._count, inputs, device=self._device)

    def _stage(self, layer: int) -> tuple[wp.array, wp.array, wp.array]:
        return self._points[layer], self._jacobians[layer], self._turned[layer]

    def backward(self, g_means: wp.array, g_factors: wp.array, frozen: int, losses: wp.array) -> None:
        """Computes gradients and takes an Adam step for all parameters except those of frozen layers.

        Args:
            g_means: [N] vec3 gradients of the rendering losses with respect to the means.
            g_factors: [N] mat33 gradients of the rendering losses with respect to the factors.
            frozen: number of frozen layers, counted from the coarsest.
            losses: weighted losses of each iteration without rendering losses, to which the deformation losses are
                added.
        """
        device, iteration = self._device, self._records.iteration
        if self._plan.neighbour_terms and self._graph is not None:
            sampled = [self._records.weights, self._samples, self._records.sample, self._sound]
            graph = [self._neighbours, self._pair_weights, self._distances]
            inputs = [*sampled, *graph, self._rows, self._previous_means, self.means, self.turns]
            inputs += [self._tied_means, self._tied_turns, iteration, losses]
            wp.launch(neighbour_terms, self._samples.shape[1], inputs, device=device)
        inputs = [self._terms, self._rows, self._sound, self._jacobians[-1], self._turned[-1], self._previous_factors]
        inputs += [self.deltas, self._lengths, self.means, self.factors, g_means, g_factors]
        inputs += [self._tied_means, self._tied_turns, self._g_points, self._g_jacobians, self._g_turned]
        inputs += [self.gradients[-1], self.optimizers[-1].adam, iteration, losses]
        wp.launch(gaussian_deltas.apply_deltas_backward, self._count, inputs, device=device)
        for layer in reversed(range(frozen, len(self.clusters))):
            table = self.clusters[layer]
            inputs = [self._published, self._starts[layer], table, self._sound, *self._stage(layer)]
            inputs += [self._pivots[layer], self._g_points, self._g_jacobians, self._g_turned]
            inputs += [self.gradients[layer], self.optimizers[layer].adam]
            wp.launch(cluster_map.map_clusters_backward, table.shape[0] * self._lanes, inputs, device=device)
