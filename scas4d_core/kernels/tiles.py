"""Depth sorting, and the list of Gaussians of each tile.

Gaussians are sorted by depth only once, for the entire image. The lists of the tiles are filled in
this order, so they are also sorted.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from scas4d_core.guards import COVER_SLACK
from scas4d_core.kernels import lanes
from scas4d_core.kernels.jit import HALF, ZERO, inline, kernel, parallel_kernel
from scas4d_core.kernels.projection import (
    DEPTH,
    LOWEST_X,
    MEAN_X,
    MEAN_Y,
    REACH,
    SLOPE,
    SPREAD,
    THIN,
    TILE,
)

SLACK = np.float32(COVER_SLACK)
WIDER = np.float32(1.0 + COVER_SLACK)
RADIX_BITS = 12
DIGITS = 1 << RADIX_BITS

BLOCK = lanes.ACROSS
"""Side length of a block in pixels."""

AHEAD = 8
"""Prefetch distance in Gaussians. Prefetching pays off because memory accesses in depth order are
scattered."""


@inline
def cover(splat, tile_x, tile_y):
    """Returns the mask of a tile's blocks that a Gaussian's support (an ellipse) intersects.

    Bit 8 x + y represents the block in column x and row y. The mask is exact up to a small margin,
    because the topmost and bottommost rows of the support are computed for each column of blocks.
    """
    left = lanes.ramp(np.float32(tile_x * TILE) + HALF - splat[MEAN_X])
    # Eight lanes contain the upper ends of the support in the block columns, the other eight the lower ends.
    down = lanes.ends()
    # The margin ensures that rounding never culls pixels that the blending kernels would render.
    reach = splat[REACH] * WIDER + SLACK
    dx = lanes.minimum(lanes.maximum(down * splat[LOWEST_X], left), left + np.float32(lanes.ACROSS - 1))
    room = reach - dx * dx * splat[THIN]
    dy = dx * splat[SLOPE] + down * lanes.square_root(lanes.maximum(room * splat[SPREAD], lanes.fill(ZERO)))
    # The rows whose centres are inside the support range from the ceiling of the upper end to the
    # floor of the lower end.
    row = down * lanes.floor(down * (dy + (splat[MEAN_Y] - HALF - np.float32(tile_y * TILE))))
    row = lanes.choose(room >= ZERO, row, down * np.float32(-1e4))
    row = lanes.minimum(lanes.maximum(row, lanes.fill(np.float32(-1.0))), lanes.fill(np.float32(TILE)))
    return lanes.column_bits(row)


@kernel
def depth_order(splats, counts, keys, order, keys_too, order_too, histogram):
    """Sorts the visible Gaussians by depth, nearest first. Gaussians with equal depths stay in row order.

    Because depths are positive, their float32 bit patterns can be sorted as integers. A stable
    radix sort with 12 bits per pass is applied to differences from the nearest depth. Two passes
    suffice if the farthest depth is at most four times the nearest depth.

    Args:
        splats: [N, 16] projected Gaussians.
        counts: [N] number of tiles of each Gaussian, or 0 if the Gaussian is culled.
        keys, keys_too: [N] uint32 scratch buffers.
        order, order_too: [N] int32 buffers, one of which receives the result.
        histogram: [DIGITS] int64 scratch buffer.

    Returns:
        The number of visible Gaussians, and the buffer that contains their rows in depth order.
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
    nearest, farthest = np.uint32(0xFFFFFFFF), np.uint32(0)
    for k in range(visible):
        nearest, farthest = min(nearest, bits[k]), max(farthest, bits[k])
    for k in range(visible):
        keys[k] = bits[k] - nearest
    shift = np.uint32(0)
    last = np.uint32(DIGITS - 1)
    while visible > 0 and (farthest - nearest) >> shift != 0:
        for k in range(DIGITS):
            histogram[k] = 0
        for k in range(visible):
            histogram[(keys[k] >> shift) & last] += 1
        total = 0
        for k in range(DIGITS):
            here = histogram[k]
            histogram[k] = total
            total += here
        for k in range(visible):
            digit = (keys[k] >> shift) & last
            place = histogram[digit]
            histogram[digit] = place + 1
            keys_too[place] = keys[k]
            order_too[place] = order[k]
        keys, keys_too = keys_too, keys
        order, order_too = order_too, order
        shift += np.uint32(RADIX_BITS)
    return visible, order


@kernel
def share_pairs(order, visible, counts, shares, begins):
    """Divides the Gaussians among tasks so that all tasks process similar numbers of pairs.

    Args:
        order, visible: outputs of ``depth_order``.
        counts: [N] number of tiles in each bounding box.
        shares: [tasks + 1] int64 output, first Gaussian of each task in depth order.
        begins: [tasks] int64 output, first pair of each task.

    Returns:
        Upper bound on the number of Gaussian–tile pairs: the number of tiles in all bounding boxes.
    """
    tasks = begins.shape[0]
    total = 0
    for i in range(counts.shape[0]):
        total += counts[i]
    task = before = 0
    for k in range(visible):
        while task < tasks and before * tasks >= total * task:
            shares[task], begins[task] = k, before
            task += 1
        before += counts[order[k]]
    shares[task:], begins[task:] = visible, before
    return total


@kernel
def cover_tiles_task(
    task, splats, rects, order, visible, tiles_x, drawn, learnt, shares, begins, ends, counts, firsts, pairs, covers,
    tile_counts,
):  # fmt: skip
    """Processes the Gaussians of one task of ``cover_tiles``."""
    for tile in range(tile_counts.shape[1]):
        tile_counts[task, tile] = 0
    pair = begins[task]
    outside = 0
    for k in range(shares[task], shares[task + 1]):
        i = order[k]
        ahead = order[min(k + AHEAD, visible - 1)]
        lanes.prefetch_row(splats, ahead)
        lanes.prefetch_row(rects, ahead)
        firsts[i] = pair
        for tile_y in range(rects[i, 1], rects[i, 3]):
            for tile_x in range(rects[i, 0], rects[i, 2]):
                tile = tile_y * tiles_x + tile_x
                if drawn[tile] == 0 and learnt[i] == 0:
                    continue
                blocks = cover(splats[i], tile_x, tile_y)
                outside += np.int64(learnt[i] != 0 and (blocks & ~drawn[tile]) != 0)
                blocks &= drawn[tile]
                # A pair is always written but only kept if Gaussian and tile intersect. This order
                # avoids mispredicted branches.
                reached = np.int64(blocks != 0)
                pairs[pair, 0] = i
                pairs[pair, 1] = tile
                covers[pair] = blocks
                tile_counts[task, tile] += reached
                pair += reached
        counts[i] = pair - firsts[i]
    ends[task] = pair
    return outside


@parallel_kernel
def cover_tiles(
    splats, rects, order, visible, tiles_x, drawn, learnt, shares, begins, ends, counts, firsts, pairs, covers,
    tile_counts,
):  # fmt: skip
    """Lists the Gaussian–tile pairs whose supports and tiles intersect, in depth order.

    Args:
        splats, rects: outputs of ``projection.project``.
        order, visible: outputs of ``depth_order``.
        tiles_x: number of tile columns.
        drawn: [tiles] uint64 mask of the blocks to render. Other blocks are ignored.
        learnt: [N] uint8 mask of the Gaussians that should stay within the rendered blocks.
        shares: [tasks + 1] first Gaussian of each task in depth order, from ``share_pairs``.
        begins: [tasks] first pair of each task, from ``share_pairs``.
        ends: [tasks] int64 output, end of each task's pairs.
        counts: [N] number of tiles in each bounding box, replaced by the number of pairs of each Gaussian.
        firsts: [N] int64 output, first pair of each Gaussian. Pairs of a Gaussian are contiguous.
        pairs: [pairs, 2] int32 output, Gaussian and tile of each pair.
        covers: [pairs] uint64 output, block mask of each pair; see ``cover``.
        tile_counts: [tasks, tiles] int32 output, number of pairs in each tile.

    Returns:
        Number of pairs in which such a Gaussian extends beyond the rendered blocks.
    """
    tasks = begins.shape[0]
    left = np.empty(tasks, np.int64)  # np.zeros would be a parallel region of its own
    for task in prange(tasks):
        left[task] = cover_tiles_task(
            np.int64(task), splats, rects, order, visible, tiles_x, drawn, learnt, shares, begins, ends, counts,
            firsts, pairs, covers, tile_counts,
        )  # fmt: skip
    outside = 0
    for task in range(tasks):
        outside += left[task]
    return outside


@kernel
def mark_blocks(splats, rects, chosen, tiles_x, marks):
    """Marks the blocks that the supports of Gaussians intersect.

    Args:
        splats, rects: outputs of ``projection.project``.
        chosen: [N] uint8 mask of the Gaussians to consider.
        tiles_x: number of tile columns.
        marks: [tiles] uint64 block masks, in which bits are set.
    """
    for i in range(rects.shape[0]):
        if chosen[i] == 0:
            continue
        for tile_y in range(rects[i, 1], rects[i, 3]):
            for tile_x in range(rects[i, 0], rects[i, 2]):
                marks[tile_y * tiles_x + tile_x] |= cover(splats[i], tile_x, tile_y)


@kernel
def find_meeting(splats, rects, tiles_x, drawn, meets):
    """Finds the Gaussians whose support intersects any of the blocks to render.

    Args:
        splats, rects: outputs of ``projection.project``.
        tiles_x: number of tile columns.
        drawn: [tiles] uint64 mask of the blocks to render.
        meets: [N] bool output.
    """
    for i in range(rects.shape[0]):
        meets[i] = False
        for tile_y in range(rects[i, 1], rects[i, 3]):
            for tile_x in range(rects[i, 0], rects[i, 2]):
                tile = tile_y * tiles_x + tile_x
                if drawn[tile] != 0 and (cover(splats[i], tile_x, tile_y) & drawn[tile]) != 0:
                    meets[i] = True


@kernel
def tile_offsets(tile_counts, starts, cursors):
    """Computes the offset of each tile's list, and of each task's part of it.

    Args:
        tile_counts: [tasks, tiles] number of pairs in each tile, from ``cover_tiles``.
        starts: [tiles + 1] output, start of each tile's list.
        cursors: [tasks, tiles] output, start of each task's part in each tile's list.

    Returns:
        Total number of entries in all lists.
    """
    total = 0
    for tile in range(tile_counts.shape[1]):
        starts[tile] = total
        for task in range(tile_counts.shape[0]):
            cursors[task, tile] = total
            total += tile_counts[task, tile]
    starts[tile_counts.shape[1]] = total
    return total


@parallel_kernel
def fill_tiles(begins, ends, pairs, covers, cursors, items, slots, entry_covers):
    """Writes the lists of the tiles in depth order.

    Each task writes its part of every list at the offsets from ``tile_offsets``.

    Args:
        begins, ends, pairs, covers: see ``cover_tiles``.
        cursors: [tasks, tiles] int64 offsets, which are advanced.
        items: [entries] int32 output, Gaussian of each entry.
        slots: [entries] int32 output, pair of each entry.
        entry_covers: [entries] uint64 output, block mask of each entry.
    """
    for task in prange(begins.shape[0]):
        for pair in range(begins[task], ends[task]):
            tile = pairs[pair, 1]
            place = cursors[task, tile]
            cursors[task, tile] = place + 1
            items[place] = pairs[pair, 0]
            slots[place] = pair
            entry_covers[place] = covers[pair]
