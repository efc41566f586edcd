"""Deformation D_t of all moving Gaussians and its backward pass, combining ``cascade`` and ``deltas``.

Gaussians are processed in blocks of sixteen. All Gaussians of a block belong to one cluster of the
finest layer, and hence to one cluster in every layer. If the size of a cluster is not a multiple of
sixteen, the last block of the cluster repeats its last Gaussian.

Only points are stored between layers, because pivots are means of points. The backward pass
recomputes factors and rotations, because recomputation is cheaper than memory access. Clusters are
nested, so parts with whole clusters of the coarsest layer are independent in every layer. The parts
run in parallel. A frozen layer is applied once (``freeze_layer``), and later passes skip the layer. The reference
implementation is ``engines.torch.deformation``.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from scas4d_core.kernels import lanes
from scas4d_core.kernels.cascade import (
    apply_cluster_map,
    apply_cluster_map_backward,
    cluster_gradient,
    cluster_table,
    move_through_layer,
)
from scas4d_core.kernels.deltas import apply_gaussian_deltas, apply_gaussian_deltas_backward
from scas4d_core.kernels.jit import inline, kernel, parallel_kernel
from scas4d_core.kernels.neighbour_terms import sum_accumulators

CARRIED = 13 * lanes.COUNT
"""Number of values in the factors and rotations of a block."""


@kernel
def prefetch(block, rows, one, two):
    """Prefetches the rows of the Gaussians of a block from two arrays.

    Prefetching pays off because the rows are scattered in memory.
    """
    block = min(block, rows.shape[0] - 1)
    for lane in range(lanes.COUNT):
        lanes.prefetch_row(one, rows[block, lane])
        lanes.prefetch_row(two, rows[block, lane])


@kernel
def move_points(block, table, about_origin, points, layer, out, place):
    """Applies a layer to the points of a block in ``points[layer]``.

    The result is stored in ``out``, starting at flat index ``place``.
    """
    first = (layer * points.shape[1] + block) * 3 * lanes.COUNT
    x, y, z = move_through_layer(
        table, about_origin, lanes.load(points, first), lanes.load(points, first + lanes.COUNT),
        lanes.load(points, first + 2 * lanes.COUNT),
    )  # fmt: skip
    lanes.store(out, place, x)
    lanes.store(out, place + lanes.COUNT, y)
    lanes.store(out, place + 2 * lanes.COUNT, z)


@kernel
def sum_block(block, points, layer, present, sums):
    """Stores the sum of a block's points before a layer in ``sums[layer, block]``."""
    first = (layer * points.shape[1] + block) * 3 * lanes.COUNT
    weight = lanes.load(present, block * lanes.COUNT)
    for k in range(3):
        sums[layer, block, k] = lanes.sum_of(weight * lanes.load(points, first + lanes.COUNT * k))


@parallel_kernel
def block_sums(points, present, sums):
    """Computes the sums of points before the first layer, which are ``sums[0]`` of ``deform``."""
    for block in prange(points.shape[1]):
        sum_block(np.int64(block), points, np.int64(0), present, sums)


@kernel
def load_blocks(means, factors, rows, points, entering):
    """Loads the Gaussians of a state into blocks.

    Args:
        means, factors: [N, 3] and [N, 3, 3] arrays of the state.
        rows: [B, 16] rows of each block's Gaussians.
        points: [L, B, 3, 16] points before each layer, of which the first layer is filled.
        entering: [B, 208] values before the first layer, of which the factors are filled.
    """
    for block in range(len(rows)):
        for lane in range(lanes.COUNT):
            row = rows[block, lane]
            for k in range(3):
                points[0, block, k, lane] = means[row, k]
                for j in range(3):
                    entering[block, (3 * k + j) * lanes.COUNT + lane] = factors[row, k, j]


@kernel
def fill_tables(part, layer, parameters, parts, ranges, sums, tables):
    """Computes the tables of a layer's clusters in one part; see ``deform``."""
    for j in range(parts[part, 1 + layer], parts[part + 1, 1 + layer]):
        cluster_table(parameters[j], sums[layer], ranges[j, 0], ranges[j, 1], ranges[j, 2], tables[j])


@kernel
def move_to_next_layer(part, layer, parts, clusters, present, about_origin, points, sums, tables):
    """Computes the points and sums before the next layer in one part; see ``deform``."""
    blocks = clusters.shape[0]
    for block in range(parts[part, 0], parts[part + 1, 0]):
        place = ((layer + 1) * blocks + block) * 3 * lanes.COUNT
        move_points(block, tables[clusters[block, layer]], about_origin, points, layer, points, place)
        sum_block(block, points, layer + 1, present, sums)


@kernel
def freeze_part(
    part, layer, parameters, parts, ranges, clusters, present, entering, about_origin, separate, points, sums, tables
):  # fmt: skip
    """Freezes a layer in one part; see ``freeze_layer``."""
    fill_tables(part, layer, parameters, parts, ranges, sums, tables)
    for block in range(parts[part, 0], parts[part + 1, 0]):
        place = (layer * clusters.shape[0] + block) * 3 * lanes.COUNT
        apply_cluster_map(
            tables[clusters[block, layer]], about_origin, separate, points, place, entering[block], present,
            block * lanes.COUNT, None,
        )  # fmt: skip
    move_to_next_layer(part, layer, parts, clusters, present, about_origin, points, sums, tables)


@parallel_kernel
def freeze_layer(
    order, shares, layer, parameters, parts, ranges, clusters, present, entering, about_origin, separate, points,
    sums, tables,
):  # fmt: skip
    """Freezes a layer by applying the layer to its input.

    The function also fills the points and sums of the next layer, and the tables of the clusters of
    this layer. For the other arguments, see ``deform``.

    Args:
        layer: layer to freeze, which must not be the last layer.
        entering: [B, 13 · 16] factors and rotations before this layer, replaced by factors and
            rotations before the next layer.
    """
    for task in prange(shares.shape[0] - 1):
        for part in order[shares[task] : shares[task + 1]]:
            freeze_part(
                part, layer, parameters, parts, ranges, clusters, present, entering, about_origin, separate, points,
                sums, tables,
            )  # fmt: skip


@inline
def copy_row(rows, row, out, place):
    """Copies the factors and rotations of a block to flat index ``place`` in another array."""
    for k in range(0, CARRIED, lanes.COUNT):
        lanes.store(out, place + k, lanes.load(rows, row * CARRIED + k))


@kernel
def deform_part(
    part, first, parameters, parts, ranges, clusters, entries, rows, present, entering, deltas, about_origin, separate,
    points, sums, tables, means, factors, state, guard_counts,
):  # fmt: skip
    """Deforms the Gaussians of one part; see ``deform``."""
    blocks, layers = clusters.shape
    for layer in range(first, layers):
        fill_tables(part, layer, parameters, parts, ranges, sums, tables)
        if layer + 1 < layers:
            move_to_next_layer(part, layer, parts, clusters, present, about_origin, points, sums, tables)
    for k in range(guard_counts.shape[1]):
        guard_counts[part, k] = 0
    v = np.empty(CARRIED, np.float32)
    moved_points = np.empty(3 * lanes.COUNT, np.float32)
    for block in range(parts[part, 0], parts[part + 1, 0]):
        prefetch(block + 1, rows, means, factors)
        copy_row(entering, block, v, 0)
        for layer in range(first, layers):
            place = (layer * blocks + block) * 3 * lanes.COUNT
            apply_cluster_map(
                tables[clusters[block, layer]], about_origin, separate, points, place, v, present,
                block * lanes.COUNT, guard_counts[part],
            )  # fmt: skip
        if layers > 0:
            move_points(
                block, tables[clusters[block, layers - 1]], about_origin, points, layers - 1, moved_points,
                np.int64(0),
            )  # fmt: skip
        else:
            for k in range(3):
                lanes.store(moved_points, lanes.COUNT * k, lanes.load(points, (3 * block + k) * lanes.COUNT))
        apply_gaussian_deltas(
            deltas,
            entries,
            rows,
            block * lanes.COUNT,
            present,
            v,
            moved_points,
            means,
            factors,
            state,
            guard_counts[part],
        )


@parallel_kernel
def deform(
    order, shares, first, parameters, parts, ranges, clusters, entries, rows, present, entering, deltas, about_origin,
    separate, points, sums, tables, means, factors, state, guard_counts,
):  # fmt: skip
    """Deforms M of N Gaussians, grouped into B blocks, with L layers that have K clusters in total.

    Args:
        order: [P] int64 parts, grouped by task.
        shares: [tasks + 1] int64 start of each task's parts in ``order``; see ``balance.distribute``.
        first: first layer that is not frozen. Points, sums and tables of frozen layers are reused.
        parameters: [K, 10] parameters of all clusters, ordered by layer from coarse to fine.
        parts: [P + 1, 1 + L] int64 first block of each of the P parts, and its first cluster in each layer. The last
            row contains the ends.
        ranges: [K, 3] int64 first block, last block + 1, and number of Gaussians of each cluster
            that are not held back.
        clusters: [B, L] int64 cluster of each block in each layer.
        entries: [B, 16] int64 indices of the Gaussians among the M moving ones.
        rows: [B, 16] int64 indices of the Gaussians among all N.
        present: [B, 16] float32 mask: 0 for repeated Gaussians and for Gaussians that are held back
            because of non-finite values, otherwise 1.
        entering: [B, 13 · 16] factors 0–8 and rotations 9–12 before layer ``first``. Without frozen layers, these are
            the factors of frame t−1 and the identity.
        deltas: [M, 9] per-Gaussian deltas Δp, Δr, Δs.
        about_origin: 0 for the centred cluster map, 1 for the published one.
        separate: if None, J is applied to the factors. Otherwise, factors remain unchanged.
        points: [max(L, 1), B, 3, 16] points before each layer. The points of layer ``first`` are
            read, and the points of later layers are filled.
        sums: [max(L, 1), B, 3] sums of the points in each block, read and filled like ``points``.
        tables: [K, 26] output, tables of the clusters.
        means: [N, 3] output, written at ``rows``.
        factors: [N, 3, 3] output, written at ``rows``.
        state: [M, 16] output. Only means and rotations are written. See ``deltas`` for the columns.
        guard_counts: [P, 3] int64 output, number of times each guard in ``cascade.COUNTED_GUARDS`` was triggered.
    """
    for task in prange(shares.shape[0] - 1):
        for part in order[shares[task] : shares[task + 1]]:
            deform_part(
                part, first, parameters, parts, ranges, clusters, entries, rows, present, entering, deltas,
                about_origin, separate, points, sums, tables, means, factors, state, guard_counts,
            )  # fmt: skip


@kernel
def deform_backward_part(
    part, first, parts, ranges, clusters, entries, rows, present, entering, deltas, about_origin, separate, points,
    tables, scale_weight, bounds, g_means, g_factors, accumulators, g_tied, records, gradients, g_deltas, losses,
):  # fmt: skip
    """Backpropagates through the Gaussians and clusters of one part; see ``deform_backward``."""
    blocks, layers = clusters.shape
    v = np.empty((layers + 1) * CARRIED, np.float32)
    g = np.empty(16 * lanes.COUNT, np.float32)
    begin, end = parts[part, 0], parts[part + 1, 0]
    sum_accumulators(accumulators, entries[begin, 0], entries[end - 1, lanes.COUNT - 1] + 1, g_tied)
    for block in range(begin, end):
        prefetch(block + 1, rows, g_means, g_factors)
        copy_row(entering, block, v, first * CARRIED)
        for layer in range(first, layers):
            leaving = v[(layer + 1) * CARRIED : (layer + 2) * CARRIED]
            copy_row(v, layer, leaving, 0)
            place = (layer * blocks + block) * 3 * lanes.COUNT
            apply_cluster_map(
                tables[clusters[block, layer]], about_origin, separate, points, place, leaving, present,
                block * lanes.COUNT, None,
            )  # fmt: skip
        losses[block] = apply_gaussian_deltas_backward(
            deltas, entries, rows, block * lanes.COUNT, present, v, layers * CARRIED, scale_weight, bounds,
            g_means, g_factors, g_tied, g, g_deltas,
        )  # fmt: skip
        for back in range(layers - first):
            layer = layers - 1 - back
            place = (layer * blocks + block) * 3 * lanes.COUNT
            record = (block * layers + layer) * records.shape[2]
            apply_cluster_map_backward(
                tables[clusters[block, layer]], about_origin, separate, points, place, v, layer * CARRIED, g,
                records, record,
            )  # fmt: skip
    for layer in range(first, layers):
        for j in range(parts[part, 1 + layer], parts[part + 1, 1 + layer]):
            cluster_gradient(records, layer, ranges[j, 0], ranges[j, 1], tables[j], gradients[j])


@parallel_kernel
def deform_backward(
    order, shares, first, parts, ranges, clusters, entries, rows, present, entering, deltas, about_origin, separate,
    points, tables, scale_weight, bounds, g_means, g_factors, accumulators, g_tied, records, gradients, g_deltas,
    losses,
):  # fmt: skip
    """Backpropagates through ``deform``, and adds the gradient of the scale loss.

    Args:
        order … tables: see ``deform``, which must have been called first. Frozen layers receive no gradient.
        scale_weight: weight of the scale loss, divided by the number of averaged values, 3M. If the
            weight is 0, the loss has no gradient.
        bounds: [M, 3] axis lengths above which the scale loss applies, in metres.
        g_means: [N, 3] gradients of the means.
        g_factors: [N, 3, 3] gradients of the factors.
        accumulators: [4, M, 8] additional gradients of means and rotations, from ``neighbour_terms``.
        g_tied: [M, 8] scratch buffer for their sums.
        records: [B, L, 32] scratch buffer.
        gradients: [K, 10] output, gradients of the cluster parameters.
        g_deltas: [M, 9] output, gradients of the deltas.
        losses: [B] output, total length by which the axes in each block exceed their bounds, in metres.
    """
    for task in prange(shares.shape[0] - 1):
        for part in order[shares[task] : shares[task + 1]]:
            deform_backward_part(
                part, first, parts, ranges, clusters, entries, rows, present, entering, deltas, about_origin, separate,
                points, tables, scale_weight, bounds, g_means, g_factors, accumulators, g_tied, records, gradients,
                g_deltas, losses,
            )  # fmt: skip
