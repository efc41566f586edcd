"""Deformation D_t of one frame on the CPU, with fused kernels for the forward and backward passes.

Reference implementation: ``engines.torch.deformation``. Buffers are allocated once per hierarchy.

Gaussians with non-finite values at the start of an update are held back. They remain unchanged and do not contribute to
cluster pivots or neighbour terms. ``CpuDeformation.guards`` counts them.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scas4d_core.gaussians import Gaussians
from scas4d_core.guards import GuardCounts
from scas4d_core.kernels import balance, neighbour_terms
from scas4d_core.kernels.cascade import COUNTED_GUARDS, PARAMETERS, RECORD, TABLE
from scas4d_core.kernels.deform import CARRIED, block_sums, deform, deform_backward, freeze_layer, load_blocks
from scas4d_core.kernels.deltas import PREVIOUS, STATE, TIED, TURN
from scas4d_core.kernels.jit import threads
from scas4d_core.kernels.lanes import COUNT
from scas4d_core.structure.hierarchy import Hierarchy
from scas4d_core.structure.neighbours import Neighbours

Array = NDArray[np.float32]


class CpuDeformation:
    """Cluster cascade, per-Gaussian deltas and neighbour terms for one hierarchy.

    Args:
        hierarchy: cluster hierarchy of the moving Gaussians.
        neighbours: neighbour graph, or None if no loss term needs it.
        bounds: [M, 3] axis lengths above which the scale loss applies, in metres; see ``Structure.length_bounds``.
        cluster_map, covariance: variants of the deformation; see ``engines.torch.deformation``.

    Attributes:
        clusters: [K, 10] parameters of each layer, with columns r, t, c, s.
        deltas: [M, 9] per-Gaussian deltas, with columns Δp, Δr, Δs.
        cluster_gradients, delta_gradients: gradients of ``clusters`` and ``deltas``, filled by ``backward``.
        means: [N, 3] means of all Gaussians, filled by ``forward``.
        factors: [N, 3, 3] covariance factors of all Gaussians, filled by ``forward``.
        turns: [M, 4] rotations since the previous frame, filled by ``forward``.
        held_back: [held] int64 rows with non-finite values in Θ_{t−1}, found by ``start``.
        guards: number of times each guard was triggered since the last ``reset``. ``forward`` counts the guards
            in ``cascade.COUNTED_GUARDS``, excluding frozen layers. ``start`` counts all others.
    """

    def __init__(
        self,
        hierarchy: Hierarchy,
        neighbours: Neighbours | None,
        bounds: Array,
        cluster_map: Literal["centred", "published"],
        covariance: Literal["entangled", "separate"] = "entangled",
    ) -> None:
        self.hierarchy = hierarchy
        self.neighbours = neighbours
        self._bounds = bounds
        self._about_origin = np.float32(cluster_map == "published")
        self._separate = True if covariance == "separate" else None
        count = len(hierarchy.rows)
        layers = len(hierarchy.sizes)
        blocks = Blocks.of(hierarchy)
        self._offsets, self._ranges, self._clusters_of = blocks.offsets, blocks.ranges, blocks.clusters
        self._parts = blocks.parts()
        self._part_shares = np.zeros(0, np.int64), np.zeros(0, np.int64)
        self._entries, self._rows, self._present = blocks.entries, hierarchy.rows[blocks.entries], blocks.present
        self._all_present, self._all_ranges = blocks.present, blocks.ranges
        self._weights = np.zeros((count, 0), np.float32) if neighbours is None else neighbours.weights
        self._parameters = np.zeros((blocks.offsets[-1], PARAMETERS), np.float32)
        self._gradients = np.zeros_like(self._parameters)
        self._tables = np.zeros((len(self._parameters), TABLE), np.float32)
        ends = blocks.offsets[1:-1]
        self.clusters, self.cluster_gradients = (
            np.split(table, ends)[:layers] for table in (self._parameters, self._gradients)
        )
        self.deltas = np.zeros((count, 9), np.float32)
        self.delta_gradients = np.zeros_like(self.deltas)
        held = len(blocks.entries)
        self._points = np.zeros((max(layers, 1), held, 3, COUNT), np.float32)
        self._sums = np.zeros((max(layers, 1), held, 3), np.float32)
        self._before, self._entering = (np.zeros((held, CARRIED), np.float32) for _ in range(2))
        self._before[:, 9 * COUNT : 10 * COUNT] = 1  # identity quaternion
        self._frozen = 0
        self._records = np.zeros((held, layers, RECORD), np.float32)
        self._excess = np.zeros(held, np.float32)
        self._state = cache_lines(count)
        self.turns = self._state[:, TURN : TURN + 4]
        self._accumulators = np.zeros((neighbour_terms.TASKS, count, TIED), np.float32)
        self._tied = np.zeros((count, TIED), np.float32)
        self._neighbour_sums = np.zeros((neighbour_terms.TASKS, 3), np.float32)
        self.means = np.zeros((0, 3), np.float32)
        self.factors = np.zeros((0, 3, 3), np.float32)
        self.guards = GuardCounts(*COUNTED_GUARDS, "held_back", "empty_cluster")
        self._guard_counts = np.zeros((len(self._parts) - 1, len(COUNTED_GUARDS)), np.int64)
        self.held_back = np.zeros(0, np.int64)
        self._held: tuple[Array, Array] = self.means, self.factors

    def start(self, previous: Gaussians) -> None:
        """Loads the state Θ_{t−1} to be deformed. Its static Gaussians remain unchanged."""
        moving = self.hierarchy.rows
        sound = np.array(np.isfinite(previous.means[moving]).all(axis=1))
        sound &= np.isfinite(previous.factors[moving]).all(axis=(1, 2))
        self.held_back = moving[~sound]
        self._held = previous.means[self.held_back], previous.factors[self.held_back]
        means, factors = previous.means, previous.factors
        if len(self.held_back):
            means, factors = means.copy(), factors.copy()
            means[self.held_back] = means[moving[sound]].mean(axis=0) if sound.any() else 0
            factors[self.held_back] = 0
        self._hold_back(sound)
        self._state[:, PREVIOUS : PREVIOUS + 3] = means[moving]
        load_blocks(
            np.ascontiguousarray(means), np.ascontiguousarray(factors), self._rows, self._points, self._before
        )  # fmt: skip
        block_sums(self._points, self._present, self._sums)
        self._unfreeze_layers()
        self.means = previous.means.copy()
        self.factors = previous.factors.copy()

    def _hold_back(self, sound: NDArray[np.bool_]) -> None:
        """Counts Gaussians that are not ``sound`` [M], and excludes them from pivots and neighbour terms."""
        self._present, self._ranges = self._all_present, self._all_ranges
        if self.neighbours is not None:
            self._weights = self.neighbours.weights
        if not sound.all():
            self._present = self._all_present * sound[self._entries]
            self._ranges = self._all_ranges.copy()
            for layer, starts in enumerate(self.hierarchy.starts):
                held = np.concatenate([[0], np.cumsum(~sound)])
                self._ranges[self._offsets[layer] : self._offsets[layer + 1], 2] -= held[starts[1:]] - held[starts[:-1]]
            if self.neighbours is not None:
                pairs = sound[:, None] & sound[self.neighbours.index]
                self._weights = np.where(pairs, self.neighbours.weights, np.float32(0))
        empty = int(np.count_nonzero(self._ranges[:, 2] == 0))
        self.guards.add(("held_back", "empty_cluster"), np.array([len(self.held_back), empty]))

    def freeze_layers(self, layers: int) -> None:
        """Freezes the first ``layers`` layers at their current parameters.

        Frozen layers are applied once and receive no gradient. The results of ``forward`` remain bit-identical. Call
        ``freeze_layers(0)`` before changing the parameters.

        Raises:
            ValueError: if the last layer would be frozen.
        """
        if layers and layers >= len(self.clusters):
            raise ValueError(
                f"cannot freeze {layers} of {len(self.clusters)} layers; the last layer must remain unfrozen"
            )
        if layers < self._frozen:
            self._unfreeze_layers()
        for layer in range(self._frozen, layers):
            freeze_layer(
                *self._shares(), layer, self._parameters, self._parts, self._ranges, self._clusters_of, self._present,
                self._entering, self._about_origin, self._separate, self._points, self._sums, self._tables,
            )  # fmt: skip
        self._frozen = layers

    def _unfreeze_layers(self) -> None:
        self._entering[:], self._frozen = self._before, 0

    def _shares(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Returns the parts that each thread processes; see ``balance.distribute``. Parts differ in size."""
        tasks = threads()
        if len(self._part_shares[1]) != tasks + 1:
            order, shares = balance.distribute(np.diff(self._parts[:, 0]), tasks)
            self._part_shares = order, shares
        return self._part_shares

    def forward(self) -> None:
        """Evaluates equations (5) to (7) and fills ``means``, ``factors`` and ``turns``."""
        deform(
            *self._shares(), self._frozen, self._parameters, self._parts, self._ranges, self._clusters_of,
            self._entries, self._rows, self._present, self._entering, self.deltas, self._about_origin, self._separate,
            self._points, self._sums, self._tables, self.means, self.factors, self._state, self._guard_counts,
        )  # fmt: skip
        self.means[self.held_back], self.factors[self.held_back] = self._held
        self.guards.add(COUNTED_GUARDS, self._guard_counts)

    def neighbour_losses(self, sample: NDArray[np.int64], weights: tuple[float, float, float]) -> Array:
        """Returns the mean rigidity, isometry and rotation losses over the sampled pairs.

        The next call to ``backward`` includes their gradients.

        Args:
            sample: [S] sampled Gaussians, as indices in hierarchy order.
            weights: weights of the three terms.
        """
        if self.neighbours is None or len(sample) == 0:
            self._accumulators[:] = 0
            return np.zeros(3, np.float32)
        pairs = max(1, len(sample) * self.neighbours.index.shape[1])
        neighbour_terms.neighbour_terms(
            self._state, sample, self.neighbours.index, self._weights, self.neighbours.distances,
            np.array(weights, np.float32) / np.float32(pairs), self._accumulators, self._neighbour_sums,
        )  # fmt: skip
        means: Array = self._neighbour_sums.sum(axis=0) / pairs
        return means

    def backward(self, g_means: Array, g_factors: Array, scale_weight: float) -> float:
        """Computes ``delta_gradients``, and ``cluster_gradients`` for all layers that are not frozen.

        Args:
            g_means: [N, 3] gradients of ``means``.
            g_factors: [N, 3, 3] gradients of ``factors``.
            scale_weight: weight of the scale loss.

        Returns:
            Unweighted scale loss in metres, averaged over axes.
        """
        axes = max(1, 3 * len(self.hierarchy.rows))
        deform_backward(
            *self._shares(), self._frozen, self._parts, self._ranges, self._clusters_of, self._entries, self._rows,
            self._present, self._entering, self.deltas, self._about_origin, self._separate, self._points, self._tables,
            np.float32(scale_weight / axes), self._bounds, g_means, g_factors, self._accumulators, self._tied,
            self._records, self._gradients, self.delta_gradients, self._excess,
        )  # fmt: skip
        return float(self._excess.sum(dtype=np.float64)) / axes


PARTS = 64
"""Maximum number of parts of a deformation, which run in parallel."""


def cache_lines(count: int) -> Array:
    """Returns a zero-filled array [count, 16] whose rows are aligned to 64-byte cache lines."""
    flat = np.zeros((count + 1) * STATE, np.float32)
    first = -(flat.ctypes.data // 4) % STATE
    return flat[first : first + count * STATE].reshape(count, STATE)


class Blocks(NamedTuple):
    """A hierarchy's Gaussians in B blocks of sixteen. In every layer, each block belongs to a single cluster.

    Attributes:
        entries: [B, 16] int64 indices of the Gaussians in hierarchy order. Partial blocks repeat their last index.
        present: [B, 16] float32 mask: 0 for repeated entries, otherwise 1.
        clusters: [B, L] int64 cluster of each block in each layer, numbered across all layers.
        offsets: [L + 1] int64 index of the first cluster in each layer, followed by the total number of clusters.
        ranges: [clusters of all layers, 3] int64 first block, last block + 1, and number of entries of each cluster.
    """

    entries: NDArray[np.int64]
    present: Array
    clusters: NDArray[np.int64]
    offsets: NDArray[np.int64]
    ranges: NDArray[np.int64]

    @classmethod
    def of(cls, hierarchy: Hierarchy) -> Blocks:
        """Builds the blocks of a hierarchy."""
        count, layers = len(hierarchy.rows), len(hierarchy.sizes)
        finest = hierarchy.starts[-1] if layers else np.array([0, count])
        per_cluster = -(-np.diff(finest) // COUNT)
        ends = np.repeat(finest[1:], per_cluster)
        nth = np.arange(len(ends)) - np.repeat(np.cumsum(per_cluster) - per_cluster, per_cluster)
        begins = np.repeat(finest[:-1], per_cluster) + COUNT * nth
        wanted = begins[:, None] + np.arange(COUNT)
        entries = np.minimum(wanted, ends[:, None] - 1)
        offsets = np.concatenate([[0], np.cumsum(hierarchy.sizes)]).astype(np.int64)
        clusters = np.zeros((len(begins), layers), np.int64)
        ranges = np.zeros((offsets[-1], 3), np.int64)
        for layer, (labels, starts) in enumerate(zip(hierarchy.labels, hierarchy.starts, strict=True)):
            clusters[:, layer] = offsets[layer] + labels[begins]
            of_layer = ranges[offsets[layer] : offsets[layer + 1]]
            of_layer[:, 0] = np.searchsorted(begins, starts[:-1])
            of_layer[:, 1] = np.searchsorted(begins, starts[1:])
            of_layer[:, 2] = np.diff(starts)
        return cls(np.ascontiguousarray(entries), (wanted == entries).astype(np.float32), clusters, offsets, ranges)

    def parts(self) -> NDArray[np.int64]:
        """Returns the boundaries of parts of similar size, as in ``kernels.deform.deform``.

        Each part contains whole clusters of the coarsest layer, and therefore of every layer.
        """
        count, layers = self.clusters.shape
        starts = self.ranges[self.offsets[0] : self.offsets[1], 0] if layers else np.arange(count)
        wanted = np.linspace(0, count, PARTS, endpoint=False)
        begins = starts[np.unique(np.searchsorted(starts, wanted, side="right") - 1)] if count else starts[:0]
        firsts = np.concatenate([begins[:, None], self.clusters[begins]], axis=1)
        return np.concatenate([firsts, [[count, *self.offsets[1:]][: layers + 1]]])
