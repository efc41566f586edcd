"""Depth order and tile lists. One global sort; lists filled in that order are sorted by construction."""

from __future__ import annotations

import numpy as np
from numba import prange

from scas4d_core.kernels.jit import TWO, ZERO, inline, kernel, parallel_kernel
from scas4d_core.kernels.projection import CHUNK, CONIC_A, CONIC_B, CONIC_C, DEPTH, MEAN_X, MEAN_Y, REACH, TILE

RADIX_BITS = 11


@inline
def tile_is_reached(splat, tile_x, tile_y):
    """Whether the support (an ellipse) meets the tile's square of pixel centres: exact, so culling by it is."""
    low_x = np.float32(tile_x * TILE) + np.float32(0.5) - splat[MEAN_X]
    low_y = np.float32(tile_y * TILE) + np.float32(0.5) - splat[MEAN_Y]
    high_x = low_x + np.float32(TILE - 1)
    high_y = low_y + np.float32(TILE - 1)
    a, b, c = splat[CONIC_A], splat[CONIC_B], splat[CONIC_C]
    # The nearest corner direction: the form is smallest on the one or two edges that face the centre.
    dx = min(max(ZERO, low_x), high_x)
    dy = min(max(ZERO, low_y), high_y)
    best = np.float32(3e38)
    if dx == ZERO and dy == ZERO:
        best = ZERO
    if dx != ZERO:
        y = min(max(-b * dx / c, low_y), high_y)
        best = min(best, a * dx * dx + TWO * b * dx * y + c * y * y)
    if dy != ZERO:
        x = min(max(-b * dy / a, low_x), high_x)
        best = min(best, a * x * x + TWO * b * x * dy + c * dy * dy)
    # Rounding must not cull what the blending kernels would still draw.
    return best <= splat[REACH] * np.float32(1.0001) + np.float32(1e-4)


@kernel
def depth_order(splats, counts, keys, order, keys_too, order_too, histogram):
    """Sort the visible Gaussians by depth, nearest first; equal depths keep row order.

    Depths are positive, so their float32 bits sort as integers; three stable passes of 11 bits.

    Args:
        splats: [N, 8]; counts: [N] tiles of each, 0 where culled.
        keys, keys_too: scratch [N] uint32. order, order_too: [N] int32; the result is in ``order_too``.
        histogram: scratch [2048] int64.

    Returns:
        How many are visible.
    """
    visible = 0
    for i in range(counts.shape[0]):
        if counts[i] > 0:
            order[visible] = i
            visible += 1
    depths = np.empty(visible, np.float32)
    for k in range(visible):
        depths[k] = splats[order[k], DEPTH]
    bits = depths.view(np.uint32)
    for k in range(visible):
        keys[k] = bits[k]
    source_keys, source_order, target_keys, target_order = keys, order, keys_too, order_too
    for step in range(3):
        shift = np.uint32(step * RADIX_BITS)
        histogram[:] = 0
        for k in range(visible):
            histogram[(source_keys[k] >> shift) & np.uint32(2047)] += 1
        total = 0
        for k in range(2048):
            here = histogram[k]
            histogram[k] = total
            total += here
        for k in range(visible):
            digit = (source_keys[k] >> shift) & np.uint32(2047)
            place = histogram[digit]
            histogram[digit] = place + 1
            target_keys[place] = source_keys[k]
            target_order[place] = source_order[k]
        source_keys, target_keys = target_keys, source_keys
        source_order, target_order = target_order, source_order
    return visible


@kernel
def pair_offsets(counts, offsets):
    """Exclusive sums of ``counts`` into ``offsets`` [N + 1] int64: where each Gaussian's pairs begin."""
    total = 0
    for i in range(counts.shape[0]):
        offsets[i] = total
        total += counts[i]
    offsets[counts.shape[0]] = total
    return total


@parallel_kernel
def reach_tiles(splats, rects, counts, offsets, pair_used):
    """Mark which tiles of each Gaussian's box its support reaches.

    Args:
        offsets: [N + 1] where each Gaussian's pairs begin (a pair per tile of its box, row by row).
        pair_used: out [pairs] uint8: 1 where the tile is reached (other pairs have no gradient).
    """
    count = counts.shape[0]
    for task in prange((count + CHUNK - 1) // CHUNK):
        for i in range(task * CHUNK, min(count, (task + 1) * CHUNK)):
            if counts[i] == 1:
                pair_used[offsets[i]] = 1
            elif counts[i] > 1:
                pair = offsets[i]
                for tile_y in range(rects[i, 1], rects[i, 3]):
                    for tile_x in range(rects[i, 0], rects[i, 2]):
                        pair_used[pair] = 1 if tile_is_reached(splats[i], tile_x, tile_y) else 0
                        pair += 1


@kernel
def count_tiles(rects, order, visible, offsets, pair_used, tiles_x, tile_counts):
    """Gaussians that reach each tile, ``tile_counts`` [tiles] int32."""
    tile_counts[:] = 0
    for k in range(visible):
        i = order[k]
        pair = offsets[i]
        for tile_y in range(rects[i, 1], rects[i, 3]):
            for tile in range(tile_y * tiles_x + rects[i, 0], tile_y * tiles_x + rects[i, 2]):
                tile_counts[tile] += pair_used[pair]
                pair += 1


@kernel
def tile_offsets(tile_counts, starts):
    """Exclusive sums of ``tile_counts`` into ``starts`` [tiles + 1] int64; returns the total."""
    total = 0
    for tile in range(tile_counts.shape[0]):
        starts[tile] = total
        total += tile_counts[tile]
    starts[tile_counts.shape[0]] = total
    return total


@kernel
def fill_tiles(rects, order, visible, offsets, pair_used, tiles_x, starts, cursor, items, slots):
    """Write the tile lists in depth order.

    Args:
        cursor: scratch [tiles] int64. items, slots: out [entries] int32: the Gaussian and its pair.
    """
    cursor[:] = starts[:-1]
    for k in range(visible):
        i = order[k]
        pair = offsets[i]
        for tile_y in range(rects[i, 1], rects[i, 3]):
            for tile in range(tile_y * tiles_x + rects[i, 0], tile_y * tiles_x + rects[i, 2]):
                if pair_used[pair] != 0:
                    place = cursor[tile]
                    items[place] = i
                    slots[place] = pair
                    cursor[tile] = place + 1
                pair += 1
