"""Depth sorting and tile lists: one global sort, so that lists filled in this order are sorted by construction."""

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
"""Side of a block in pixels."""

SOME = 4096
"""Rows per task."""

AHEAD = 8
"""Prefetch distance in Gaussians, which are scattered in memory when in depth order."""


@inline
def cover(splat, tile_x, tile_y):
    """Returns the blocks of a tile that the support (an ellipse) intersects: bit 8 x + y for block column x and row y.

    Culling by the cover is exact: in each column of blocks, it spans the support's extreme rows.
    """
    left = lanes.ramp(np.float32(tile_x * TILE) + HALF - splat[MEAN_X])
    # Eight lanes for the upper ends of the block columns, eight for the lower ends.
    down = lanes.ends()
    # Rounding must not cull pixels that the blending kernels would render.
    reach = splat[REACH] * WIDER + SLACK
    dx = lanes.minimum(lanes.maximum(down * splat[LOWEST_X], left), left + np.float32(lanes.ACROSS - 1))
    room = reach - dx * dx * splat[THIN]
    dy = dx * splat[SLOPE] + down * lanes.square_root(lanes.maximum(room * splat[SPREAD], lanes.fill(ZERO)))
    # Rows whose centres are inside: from the ceiling of the upper end to the floor of the lower end.
    row = down * lanes.floor(down * (dy + (splat[MEAN_Y] - HALF - np.float32(tile_y * TILE))))
    row = lanes.choose(room >= ZERO, row, down * np.float32(-1e4))
    row = lanes.minimum(lanes.maximum(row, lanes.fill(np.float32(-1.0))), lanes.fill(np.float32(TILE)))
    return lanes.column_bits(row)


@kernel
def depth_order(splats, counts, keys, order, keys_too, order_too, histogram):
    """Sorts the visible Gaussians by depth, nearest first; equal depths keep the row order.

    Depths are positive, so their float32 bits sort as integers. A stable radix sort runs 12-bit passes on the
    difference from the nearest depth; two passes suffice if the farthest depth is within four times the nearest.

    Args:
        splats: [N, 16]; counts: [N] number of tiles of each, 0 if culled.
        keys, keys_too: scratch [N] uint32. order, order_too: [N] int32.
        histogram: scratch [DIGITS] int64.

    Returns:
        The number of visible Gaussians, and the one of the two arrays that contains their order.
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
def share_pairs(order, visible, counts, begins):
    """Computes the first pair of each task, ``begins`` [tasks] int64; tasks get equal shares of the order.

    Returns:
        Upper bound of the number of Gaussian–tile pairs: the tiles of all boxes.
    """
    tasks = begins.shape[0]
    total = 0
    for task in range(tasks):
        begins[task] = total
        for k in range(visible * task // tasks, visible * (task + 1) // tasks):
            total += counts[order[k]]
    return total


@kernel
def cover_tiles_task(
    task, splats, rects, order, visible, tiles_x, drawn, learnt, begins, ends, counts, firsts, pairs, covers,
    tile_counts,
):  # fmt: skip
    """Lists the tiles of the Gaussians of one task of ``cover_tiles``."""
    tasks = begins.shape[0]
    for tile in range(tile_counts.shape[1]):
        tile_counts[task, tile] = 0
    pair = begins[task]
    outside = 0
    for k in range(visible * task // tasks, visible * (task + 1) // tasks):
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
                # Always written and only kept if reached, which avoids a branch that could be mispredicted.
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
    splats, rects, order, visible, tiles_x, drawn, learnt, begins, ends, counts, firsts, pairs, covers, tile_counts
):
    """Lists the tiles that each Gaussian's support intersects, in depth order.

    Args:
        drawn: [tiles] uint64, the blocks of each tile to render; other blocks are ignored.
        learnt: [N] uint8, 1 for Gaussians that must stay within the rendered blocks.
        begins: [tasks] from ``share_pairs``. ends: out [tasks] int64, end of each task's pairs.
        counts: in: tiles of each Gaussian's box; out: tiles reached. firsts: out [N] int64, first pair of each
            Gaussian; its other pairs follow.
        pairs: out [pairs, 2] int32, Gaussian and tile. covers: out [pairs] uint64, blocks of the tile, see ``cover``.
        tile_counts: out [tasks, tiles] int32.

    Returns:
        Number of times that a learned Gaussian reached blocks that are not rendered.
    """
    tasks = begins.shape[0]
    left = np.zeros(tasks, np.int64)
    for task in prange(tasks):
        left[task] = cover_tiles_task(
            np.int64(task), splats, rects, order, visible, tiles_x, drawn, learnt, begins, ends, counts, firsts, pairs,
            covers, tile_counts,
        )  # fmt: skip
    outside = 0
    for task in range(tasks):
        outside += left[task]
    return outside


@kernel
def mark_blocks(splats, rects, chosen, tiles_x, marks):
    """Marks the blocks that the supports of Gaussians intersect.

    Args:
        splats, rects: from ``projection.project``. chosen: [N] uint8, 0 for Gaussians that are ignored.
        marks: [tiles] uint64, to which bits are added.
    """
    for i in range(rects.shape[0]):
        if chosen[i] == 0:
            continue
        for tile_y in range(rects[i, 1], rects[i, 3]):
            for tile_x in range(rects[i, 0], rects[i, 2]):
                marks[tile_y * tiles_x + tile_x] |= cover(splats[i], tile_x, tile_y)


@kernel
def find_meeting(splats, rects, tiles_x, drawn, meets):
    """Finds the Gaussians whose support intersects a block to render.

    Args:
        drawn: [tiles] uint64. meets: out [N] bool.
    """
    for i in range(rects.shape[0]):
        meets[i] = False
        for tile_y in range(rects[i, 1], rects[i, 3]):
            for tile_x in range(rects[i, 0], rects[i, 2]):
                tile = tile_y * tiles_x + tile_x
                if drawn[tile] != 0 and (cover(splats[i], tile_x, tile_y) & drawn[tile]) != 0:
                    meets[i] = True


@parallel_kernel
def put_rows(rows, places, part, whole):
    """Copies rows of one array to rows ``places`` of another.

    Args:
        rows, places: [M] int64. part: [P, K], whole: out [W, K] float32.
    """
    for task in prange((rows.shape[0] + SOME - 1) // SOME):
        for k in range(task * SOME, min(rows.shape[0], (task + 1) * SOME)):
            for column in range(part.shape[1]):
                whole[places[k], column] = part[rows[k], column]


@inline
def is_marked(blocks, tiles_x, y, x):
    """Returns whether the block of a pixel is marked."""
    number = x % TILE // BLOCK * (TILE // BLOCK) + y % TILE // BLOCK
    return (blocks[y // TILE * tiles_x + x // TILE] >> np.uint64(number)) & np.uint64(1) != 0


@kernel
def compose_box(planes, base, blocks, tiles_x, box, part, shifts):
    """Composes a box of a picture from the rendered blocks and a known base picture.

    Args:
        planes: [C, rows, stride] float32, the rendering. base: [C, H, W] float32, values of all other blocks.
        blocks: [tiles] uint64. box: first row, last row + 1, first column, last column + 1.
        part: out [C, h, w] float32, the box. shifts: out [C] float64, sums over the box of its difference from the
            base.
    """
    top, bottom, left, right = box
    for channel in range(part.shape[0]):
        shifts[channel] = 0.0
        for y in range(top, bottom):
            for x in range(left, right):
                part[channel, y - top, x - left] = base[channel, y, x]
            shift = 0.0
            for x in range(left // BLOCK * BLOCK, right, BLOCK):
                if is_marked(blocks, tiles_x, y, x):
                    for k in range(max(x, left), min(x + BLOCK, right)):
                        shift += np.float64(planes[channel, y, k] - base[channel, y, k])
                        part[channel, y - top, k - left] = planes[channel, y, k]
            shifts[channel] += shift


@kernel
def write_blocks(part, blocks, tiles_x, box, planes):
    """Copies the rendered blocks from a box to a picture, like ``compose_box``; other blocks are unchanged.

    Args:
        part: [C, h, w] float32. planes: out [C, rows, stride] float32.
    """
    top, bottom, left, right = box
    for channel in range(part.shape[0]):
        for y in range(top, bottom):
            for x in range(left // BLOCK * BLOCK, right, BLOCK):
                if is_marked(blocks, tiles_x, y, x):
                    for k in range(max(x, left), min(x + BLOCK, right)):
                        planes[channel, y, k] = part[channel, y - top, k - left]


@kernel
def tile_offsets(tile_counts, starts, cursors):
    """Computes the start of each tile's list, ``starts`` [tiles + 1], and each task's part, ``cursors`` [tasks, tiles].

    Returns:
        Number of entries of all lists.
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
    """Writes the tile lists in depth order; each task writes its share at the offsets from ``tile_offsets``.

    Args:
        cursors: [tasks, tiles] int64, advanced. items, slots: out [entries] int32, the Gaussian and its pair.
        entry_covers: out [entries] uint64.
    """
    for task in prange(begins.shape[0]):
        for pair in range(begins[task], ends[task]):
            tile = pairs[pair, 1]
            place = cursors[task, tile]
            cursors[task, tile] = place + 1
            items[place] = pairs[pair, 0]
            slots[place] = pair
            entry_covers[place] = covers[pair]
