"""Number of Gaussians blended into each pixel.

The number determines the time of an iteration. Gaussians behind the one that finishes a pixel do not count. The
reference implementation is ``engines.torch.rasterizer``.
"""

from __future__ import annotations

from math import log2

import numpy as np
from numba import prange

from scas4d_core.kernels import lanes
from scas4d_core.kernels.blend import BLOCK_X, BLOCK_Y, BLOCKS, HALF_LOG2_E, copy_blocks, without_lowest_block
from scas4d_core.kernels.jit import HALF, ONE, TWO, ZERO, kernel, parallel_kernel
from scas4d_core.kernels.projection import CONIC_A, CONIC_B, CONIC_C, LOG_OPACITY, MEAN_X, MEAN_Y, TILE


@kernel
def count_task(task, splats, starts, items, covers, tile_order, shares, size, limits, pairs):
    """Processes the tiles of one task of ``count_pairs``."""
    cap, stop = limits[1], limits[2]
    faintest = np.float32(log2(limits[0]))
    tiles_x = (size[0] + TILE - 1) // TILE
    # State of a block: transmittance (negative for finished pixels) and counts.
    step = lanes.COUNT * 2
    state = np.empty(BLOCKS * step + lanes.COUNT, np.float32)
    base = lanes.aligned(state)
    for turn in range(shares[task], shares[task + 1]):
        tile = tile_order[turn]
        y_first = (tile // tiles_x) * TILE
        x_first = (tile % tiles_x) * TILE
        for block in range(BLOCKS):
            lanes.store(state, base + block * step, lanes.fill(ONE))
            lanes.store(state, base + block * step + lanes.COUNT, lanes.fill(ZERO))
        for entry in range(starts[tile], starts[tile + 1]):
            left = covers[entry]
            splat = splats[items[entry]]
            a, b, c = splat[CONIC_A] * HALF_LOG2_E, splat[CONIC_B] * (TWO * HALF_LOG2_E), splat[CONIC_C] * HALF_LOG2_E
            log_opacity = splat[LOG_OPACITY]
            left_x = lanes.block_columns() + (np.float32(x_first) + HALF - splat[MEAN_X])
            top_y = lanes.block_rows() + (np.float32(y_first) + HALF - splat[MEAN_Y])
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
                lanes.store(
                    state,
                    place,
                    lanes.choose(stopped, ZERO - lanes.magnitude(before), lanes.choose(drawn, after, before)),
                )
                more = lanes.choose(drawn, lanes.fill(ONE), lanes.fill(ZERO))
                lanes.store(state, place + lanes.COUNT, lanes.load(state, place + lanes.COUNT) + more)
        copy_blocks(pairs, y_first, x_first, state, base + lanes.COUNT, step, False)


@parallel_kernel
def count_pairs(splats, starts, items, covers, tile_order, shares, size, limits, pairs):
    """Counts the Gaussians that ``blend`` blends into each pixel.

    Args:
        splats, starts, items, tile_order, shares, size, limits: see ``blend``.
        covers: [entries] block masks, as updated by ``blend``.
        pairs: [rows, stride] float32 output, padded to whole tiles.
    """
    for task in prange(shares.shape[0] - 1):
        count_task(np.int64(task), splats, starts, items, covers, tile_order, shares, size, limits, pairs)
