"""D_t over all moving Gaussians, and its backward: ``cascade`` and ``deltas`` combined. Twin: ``deformation``.

Gaussians are taken in blocks of sixteen of one finest cluster, hence of one cluster in every layer; where the size of a
cluster is no multiple of sixteen, its last block repeats its last Gaussian. Only points are kept between layers
(pivots are their means): the backward carries factors and turns through the layers again, which costs less than
reading them from memory. Layers that rest are applied once (``settle``), and what follows begins behind them.
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

BLOCKS = 16
"""Blocks a task."""

CARRIED = 13 * lanes.COUNT
"""Numbers of a block's factors and turns."""


@kernel
def prefetch(block, rows, one, two):
    """Prefetches the rows of a block's Gaussians in two arrays: they lie anywhere in memory."""
    block = min(block, rows.shape[0] - 1)
    for lane in range(lanes.COUNT):
        lanes.prefetch_row(one, rows[block, lane])
        lanes.prefetch_row(two, rows[block, lane])


@kernel
def move_points(block, table, about_origin, points, layer, out, place):
    """Moves the points of a block through a layer, from ``points[layer]`` to flat index ``place`` of ``out`` on."""
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
    """Sums of a block's points as they enter a layer, into ``sums[layer, block]``."""
    first = (layer * points.shape[1] + block) * 3 * lanes.COUNT
    weight = lanes.load(present, block * lanes.COUNT)
    for k in range(3):
        sums[layer, block, k] = lanes.sum_of(weight * lanes.load(points, first + lanes.COUNT * k))


@parallel_kernel
def block_sums(points, present, sums):
    """Sums of the points as they enter the first layer: ``sums[0]`` of ``deform``."""
    for block in prange(points.shape[1]):
        sum_block(np.int64(block), points, np.int64(0), present, sums)


@parallel_kernel
def freeze_layer(
    layer, parameters, offsets, ranges, clusters, present, entering, about_origin, separate, points, sums, tables
):  # fmt: skip
    """Moves what enters a layer through it, for as long as it rests: ``entering`` then enters the layer below.

    Args:
        layer: not the last. entering: [B, 13 · 16] in place, see ``deform``, which describes the others, too; of points
            and sums those of the layer below are filled, of tables those of its clusters.
    """
    blocks = clusters.shape[0]
    for j in prange(offsets[layer], offsets[layer + 1]):
        cluster_table(parameters[j], sums[layer], ranges[j, 0], ranges[j, 1], ranges[j, 2], tables[j])
    for task in prange((blocks + BLOCKS - 1) // BLOCKS):
        for block in range(np.int64(task * BLOCKS), min(blocks, np.int64((task + 1) * BLOCKS))):
            table, place = tables[clusters[block, layer]], 3 * lanes.COUNT * block
            here, below = place + layer * 3 * lanes.COUNT * blocks, place + (layer + 1) * 3 * lanes.COUNT * blocks
            apply_cluster_map(
                table, about_origin, separate, points, here, entering[block], present, block * lanes.COUNT, None
            )
            move_points(block, table, about_origin, points, layer, points, below)
            sum_block(block, points, layer + 1, present, sums)


@inline
def copy_row(rows, row, out, place):
    """Copies the row of a block to flat index ``place`` of another array."""
    for k in range(0, CARRIED, lanes.COUNT):
        lanes.store(out, place + k, lanes.load(rows, row * CARRIED + k))


@parallel_kernel
def deform(
    first, parameters, offsets, ranges, clusters, entries, rows, present, entering, deltas, about_origin, separate,
    points, sums, tables, means, factors, state, guard_counts,
):  # fmt: skip
    """Moves M of N Gaussians, in B blocks, through L layers of K clusters together.

    Args:
        first: the first layer that does not rest; the points, sums and tables of those before are as they were left.
        parameters: [K, 10], layer after layer, coarse to fine. offsets: [L + 1] int64, the first cluster of each layer.
        ranges: [K, 3] int64, each cluster's first block, its last and one more, and its number of Gaussians.
        clusters: [B, L] int64, the clusters of each block.
        entries, rows: [B, 16] int64, each Gaussian's row among the M and among the N.
        present: [B, 16] float32, 0 where a Gaussian is repeated, else 1.
        entering: [B, 13 · 16] factors 0–8 and turns 9–12 as they enter layer ``first``; of frame t−1 those are its
            factors and no turn. deltas: [M, 9] Δp, Δr, Δs.
        about_origin: 0 for the centred map, 1 for the published one. separate: None: J is applied to the factors; else
            nothing.
        points: [max(L, 1), B, 3, 16] as they enter each layer; of ``first`` given, of those below filled.
        sums: [max(L, 1), B, 3] of them; likewise. tables: out [K, 26].
        means [N, 3], factors [N, 3, 3]: out at ``rows``. state: [M, 16], out its means and turns, see ``deltas``.
        guard_counts: out [tasks of ``BLOCKS`` blocks, 3] int64, how often the guards in ``cascade.COUNTED_GUARDS``
            acted.
    """
    blocks, layers = clusters.shape
    tasks = (blocks + BLOCKS - 1) // BLOCKS
    for layer in range(first, layers):
        for j in prange(offsets[layer], offsets[layer + 1]):
            cluster_table(parameters[j], sums[layer], ranges[j, 0], ranges[j, 1], ranges[j, 2], tables[j])
        if layer + 1 < layers:
            for task in prange(tasks):
                for block in range(np.int64(task * BLOCKS), min(blocks, np.int64((task + 1) * BLOCKS))):
                    place = ((layer + 1) * blocks + block) * 3 * lanes.COUNT
                    move_points(block, tables[clusters[block, layer]], about_origin, points, layer, points, place)
                    sum_block(block, points, layer + 1, present, sums)
    for task in prange(tasks):
        for k in range(guard_counts.shape[1]):
            guard_counts[task, k] = 0
        v = np.empty(CARRIED, np.float32)
        moved_points = np.empty(3 * lanes.COUNT, np.float32)
        for block in range(np.int64(task * BLOCKS), min(blocks, np.int64((task + 1) * BLOCKS))):
            prefetch(block + 1, rows, means, factors)
            copy_row(entering, block, v, 0)
            for layer in range(first, layers):
                place = (layer * blocks + block) * 3 * lanes.COUNT
                apply_cluster_map(
                    tables[clusters[block, layer]], about_origin, separate, points, place, v, present,
                    block * lanes.COUNT, guard_counts[task],
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
                guard_counts[task],
            )


@parallel_kernel
def deform_backward(
    first, offsets, ranges, clusters, entries, rows, present, entering, deltas, about_origin, separate, points, tables,
    scale_weight, bounds, g_means, g_factors, g_tied, records, gradients, g_deltas, losses,
):  # fmt: skip
    """Backward of ``deform``, with the gradient of the scale loss added.

    Args:
        first … tables: as ``deform`` left them; layers that rest get no gradient.
        scale_weight: weight of the scale loss over its mean's count 3M; 0 leaves it out.
        bounds: [M, 3] metres, the length each axis may have.
        g_means [N, 3], g_factors [N, 3, 3]: in. g_tied: [M, 8] in, of means and turns, see ``deltas``.
        records: scratch [B, L, 32]. gradients: out [K, 10]. g_deltas: out [M, 9].
        losses: out [B], metres of excess length of the axes, summed over each block.
    """
    blocks, layers = clusters.shape
    for task in prange((blocks + BLOCKS - 1) // BLOCKS):
        v = np.empty((layers + 1) * CARRIED, np.float32)
        g = np.empty(16 * lanes.COUNT, np.float32)
        for block in range(np.int64(task * BLOCKS), min(blocks, np.int64((task + 1) * BLOCKS))):
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
        for j in prange(offsets[layer], offsets[layer + 1]):
            cluster_gradient(records, layer, ranges[j, 0], ranges[j, 1], tables[j], gradients[j])
