"""Backward pass for features only, used if positions and shapes need no gradients.

The gradient of a feature is the image gradient, summed over the pixels with the blending weights of
the Gaussian. As in ``blend``, the weights are recomputed front to back. Later entries in a tile do
not affect the weights. Results are bit-identical to ``blend_backward``. The reference
implementation is ``engines.torch.rasterizer``.
"""

from __future__ import annotations

from math import log2

import numpy as np
from numba import prange

from scas4d_core.kernels import lanes
from scas4d_core.kernels.blend import (
    AHEAD,
    BLOCK_X,
    BLOCK_Y,
    BLOCKS,
    GROUP,
    HALF_LOG2_E,
    copy_blocks,
    without_lowest_block,
)
from scas4d_core.kernels.jit import HALF, ONE, TWO, ZERO, kernel, parallel_kernel
from scas4d_core.kernels.projection import (
    CHUNK,
    CONIC_A,
    CONIC_B,
    CONIC_C,
    LOG_OPACITY,
    MEAN_X,
    MEAN_Y,
    STEEPEST,
    TILE,
)


@kernel
def blend_features_task(
    task, splats, starts, items, slots, covers, learnt, tile_order, shares, size, limits, g_image, records
):
    """Processes the tiles of one task of ``blend_features``."""
    cap, stop = limits[1], limits[2]
    faintest = np.float32(log2(limits[0]))
    tiles_x = (size[0] + TILE - 1) // TILE
    # State of a block: transmittance (negative for finished pixels) and image gradients.
    step = lanes.COUNT * (1 + GROUP)
    state = np.empty(BLOCKS * step + lanes.COUNT, np.float32)
    base = lanes.aligned(state)
    for turn in range(shares[task], shares[task + 1]):
        tile = tile_order[turn]
        y_first = (tile // tiles_x) * TILE
        x_first = (tile % tiles_x) * TILE
        for channel in range(GROUP):
            copy_blocks(g_image[channel], y_first, x_first, state, base + lanes.COUNT * (1 + channel), step, True)
        for block in range(BLOCKS):
            lanes.store(state, base + block * step, lanes.fill(ONE))
        end = starts[tile + 1]
        while end > starts[tile] and learnt[items[end - 1]] == 0:
            end -= 1
        for entry in range(starts[tile], end):
            left = covers[entry]
            lanes.prefetch_row(splats, items[min(entry + AHEAD, end - 1)])
            i = items[entry]
            splat = splats[i]
            a, b, c = splat[CONIC_A] * HALF_LOG2_E, splat[CONIC_B] * (TWO * HALF_LOG2_E), splat[CONIC_C] * HALF_LOG2_E
            log_opacity = splat[LOG_OPACITY]
            left_x = lanes.block_columns() + (np.float32(x_first) + HALF - splat[MEAN_X])
            top_y = lanes.block_rows() + (np.float32(y_first) + HALF - splat[MEAN_Y])
            t0 = t1 = t2 = t3 = lanes.fill(ZERO)
            while left != np.uint64(0):
                block = lanes.lowest_bit(left)
                left = without_lowest_block(left)
                dx = left_x + BLOCK_X[block]
                dy = top_y + BLOCK_Y[block]
                power = log_opacity - (a * dx * dx + (b * dx + c * dy) * dy)
                place = base + block * step
                before = lanes.load(state, place)
                weight = lanes.minimum(lanes.exp2(power), lanes.fill(cap)) * before
                after = before - weight
                drawn = (power >= faintest) & (after >= stop)
                stopped = (power >= faintest) & (after < stop)
                weight = lanes.choose(drawn, weight, lanes.fill(ZERO))
                lanes.store(
                    state,
                    place,
                    lanes.choose(stopped, ZERO - lanes.magnitude(before), lanes.choose(drawn, after, before)),
                )
                t0 += weight * lanes.load(state, place + lanes.COUNT)
                t1 += weight * lanes.load(state, place + 2 * lanes.COUNT)
                t2 += weight * lanes.load(state, place + 3 * lanes.COUNT)
                t3 += weight * lanes.load(state, place + 4 * lanes.COUNT)
            if learnt[i] != 0:
                lanes.store(records, slots[entry] * lanes.COUNT, lanes.sums_of((t0, t1, t2, t3)))


@parallel_kernel
def blend_features(splats, starts, items, slots, covers, learnt, tile_order, shares, size, limits, g_image, records):
    """Computes the feature gradients of every entry, i.e. of every Gaussian–tile pair.

    Args:
        splats, starts, items, slots, covers, learnt, tile_order, shares, size, limits: see ``blend.blend_backward``.
        g_image: [4, rows, stride] dL/dimage.
        records: [pairs, 16] float32 output, four sums followed by zeros.
    """
    for task in prange(shares.shape[0] - 1):
        blend_features_task(
            np.int64(task), splats, starts, items, slots, covers, learnt, tile_order, shares, size, limits, g_image,
            records,
        )  # fmt: skip


@parallel_kernel
def sum_features(counts, firsts, records, g_features, guard_counts):
    """Sums the records of each Gaussian's pairs, in the same order as ``projection.project_backward``.

    Args:
        counts: [N] number of pairs of each Gaussian.
        firsts: [N] first pair of each Gaussian.
        records: [pairs, 16] records from ``blend_features``.
        g_features: [N, 4] output, or 0 for Gaussians that have no pairs or whose sums overflow.
        guard_counts: [tasks of ``CHUNK``, 1] int64 output, number of Gaussians whose sums overflow.
    """
    count = g_features.shape[0]
    for task in prange((count + CHUNK - 1) // CHUNK):
        guard_counts[task] = 0
        for i in range(task * CHUNK, min(count, (task + 1) * CHUNK)):
            total = lanes.fill(ZERO)
            for pair in range(firsts[i], firsts[i] + counts[i]):
                total += lanes.load(records, pair * lanes.COUNT)
            lanes.store_first(g_features, GROUP * i, GROUP, total)
            if not lanes.sum_of(lanes.magnitude(total)) <= STEEPEST:
                g_features[i] = ZERO
                guard_counts[task, 0] += 1
