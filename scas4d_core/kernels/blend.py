"""Front-to-back blending of tiles, and its backward pass.

A tile consists of 8×8 blocks of 4×4 pixels, and a block is processed as one ``Lanes``. For each
Gaussian, the blocks that intersect its support (``tiles.cover``) are visited in bit order. The
reference implementation is ``engines.torch.rasterizer``.
"""

from __future__ import annotations

from math import log2

import numpy as np
from numba import prange

from scas4d_core.kernels import lanes
from scas4d_core.kernels.jit import HALF, ONE, TWO, ZERO, inline, kernel, parallel_kernel
from scas4d_core.kernels.projection import CONIC_A, CONIC_B, CONIC_C, LOG_OPACITY, MEAN_X, MEAN_Y, TILE

# Columns of the gradient record of a Gaussian–tile pair: sums over the tile's pixels of dL/dpower times monomials of
# the offset (dx, dy), followed by the feature gradients.
SUM_1, SUM_X, SUM_Y, SUM_XX, SUM_XY, SUM_YY, FEATURES = range(7)

GROUP = 4
"""Number of channels per group. Loops over the channels of a group are unrolled."""

BLOCK = lanes.ACROSS
BLOCKS = (TILE // BLOCK) ** 2
BLOCK_X = np.array([BLOCK * (block >> 3) for block in range(BLOCKS)], np.float32)
BLOCK_Y = np.array([BLOCK * (block & 7) for block in range(BLOCKS)], np.float32)
AHEAD = 4
"""Prefetch distance in entries. Prefetching pays off because the data of Gaussians is scattered in memory."""

HALF_LOG2_E = np.float32(0.5 * 1.4426950408889634)
"""Factor that converts exponents to base 2: alpha = 2^(log2(opacity) − HALF_LOG2_E · quadratic form)."""


def record_columns(channels: int) -> int:
    """Returns the number of columns of a gradient record, rounded up to a multiple of ``Lanes``."""
    return -(-(FEATURES + channels) // lanes.COUNT) * lanes.COUNT


@inline
def without_lowest_block(cover):
    """Returns a block mask with the lowest block cleared."""
    return cover & (cover - np.uint64(1))


@inline
def fetch_ahead(entry, end, items, splats, features):
    """Prefetches the data of the entry that is ``AHEAD`` positions later in the list of a tile."""
    i = items[min(entry + AHEAD, end - 1)]
    lanes.prefetch_row(splats, i)
    lanes.prefetch_row(features, i)


@kernel
def copy_blocks(plane, y_first, x_first, state, start, step, inward):
    """Copies the blocks of a tile between a plane and the block state.

    If ``inward`` is true, blocks are copied from the plane to the state, and otherwise from the
    state to the plane. The first block starts at index ``start`` of the state, and consecutive
    blocks are ``step`` apart.
    """
    for column in range(TILE // BLOCK):
        for row in range(TILE // BLOCK):
            place = start + step * (column * (TILE // BLOCK) + row)
            for y in range(BLOCK):
                for x in range(BLOCK):
                    if inward:
                        state[place + BLOCK * y + x] = plane[y_first + BLOCK * row + y, x_first + BLOCK * column + x]
                    else:
                        plane[y_first + BLOCK * row + y, x_first + BLOCK * column + x] = state[place + BLOCK * y + x]


@kernel
def blend_task(
    task,
    splats,
    features,
    groups,
    starts,
    items,
    covers,
    wanted,
    tile_order,
    shares,
    size,
    background,
    limits,
    image,
    transmittance,
):
    """Blends the tiles of one task of ``blend``."""
    cap, stop = limits[1], limits[2]
    faintest = np.float32(log2(limits[0]))
    channels = GROUP * len(groups)
    tiles_x = (size[0] + TILE - 1) // TILE
    # State of a block: transmittance (negative for finished pixels) and features.
    step = lanes.COUNT * (1 + channels)
    state = np.empty(BLOCKS * step + lanes.COUNT, np.float32)
    base = lanes.aligned(state)
    for turn in range(shares[task], shares[task + 1]):
        tile = tile_order[turn]
        x_first = (tile % tiles_x) * TILE
        y_first = (tile // tiles_x) * TILE
        for k in range(state.size):
            state[k] = ZERO
        for block in range(BLOCKS):
            lanes.store(state, base + block * step, lanes.fill(ONE))
        unfinished = wanted[tile]
        for entry in range(starts[tile], starts[tile + 1]):
            left = covers[entry] & unfinished
            seen = left
            fetch_ahead(entry, starts[tile + 1], items, splats, features)
            i = items[entry]
            splat = splats[i]
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
                alpha = lanes.minimum(lanes.exp2(power), lanes.fill(cap))
                weight = alpha * before
                after = before - weight
                drawn = (power >= faintest) & (after >= stop)
                if not lanes.any_of(drawn):
                    # The Gaussian is not visible in this block, but may finish some pixels. If the
                    # Gaussian finishes no pixel, the backward pass can skip the block. A block is
                    # not visited again after all of its pixels are finished.
                    bit = np.uint64(1) << np.uint64(block)
                    ended = (power >= faintest) & (before > ZERO)
                    if lanes.any_of(ended):
                        before = lanes.choose(ended, ZERO - before, before)
                        lanes.store(state, place, before)
                    else:
                        seen = seen & ~bit
                    if not lanes.any_of(before > ZERO):
                        unfinished = unfinished & ~bit
                    continue
                stopped = (power >= faintest) & (after < stop)
                weight = lanes.choose(drawn, weight, lanes.fill(ZERO))
                lanes.store(
                    state,
                    place,
                    lanes.choose(stopped, ZERO - lanes.magnitude(before), lanes.choose(drawn, after, before)),
                )
                for group in range(0, channels, GROUP):
                    at = place + lanes.COUNT * (1 + group)
                    lanes.store(state, at, lanes.load(state, at) + weight * features[i, group])
                    at += lanes.COUNT
                    lanes.store(state, at, lanes.load(state, at) + weight * features[i, group + 1])
                    at += lanes.COUNT
                    lanes.store(state, at, lanes.load(state, at) + weight * features[i, group + 2])
                    at += lanes.COUNT
                    lanes.store(state, at, lanes.load(state, at) + weight * features[i, group + 3])
            covers[entry] = seen
            if unfinished == np.uint64(0):
                for later in range(entry + 1, starts[tile + 1]):
                    covers[later] = np.uint64(0)
                break
        for block in range(BLOCKS):
            place = base + block * step
            light = lanes.magnitude(lanes.load(state, place))
            lanes.store(state, place, light)
            for channel in range(channels):
                at = place + lanes.COUNT * (1 + channel)
                lanes.store(state, at, lanes.load(state, at) + light * background[channel])
        copy_blocks(transmittance, y_first, x_first, state, base, step, False)
        for channel in range(channels):
            copy_blocks(image[channel], y_first, x_first, state, base + lanes.COUNT * (1 + channel), step, False)


@parallel_kernel
def blend(
    splats,
    features,
    groups,
    starts,
    items,
    covers,
    wanted,
    tile_order,
    shares,
    size,
    background,
    limits,
    image,
    transmittance,
):
    """Blends the Gaussians of each tile front to back.

    Args:
        splats: [N, 16] projected Gaussians; see ``projection``.
        features: [N, C] float32 features; C must be a multiple of 4.
        groups: tuple of length C/4, which makes the number of channels known at compile time.
        starts: [tiles + 1] start of each tile's list in ``items``.
        items: [entries] Gaussian of each entry.
        covers: [entries] uint64 block mask of each entry; see ``tiles.cover``. Blocks in which the Gaussian has no
            effect are cleared from the mask.
        wanted: [tiles] uint64 mask of the blocks to render. All other blocks are filled with the
            background.
        tile_order: int64 tiles to render, grouped by task. All other tiles remain unchanged.
        shares: [tasks + 1] int64 start of each task's tiles; see ``balance.distribute``.
        size: image size (width, height) in pixels.
        background: [C] background features.
        limits: [6] rasterizer constants, in the order of the ``Limits`` fields.
        image: [C, rows, stride] float32 output, padded to whole tiles.
        transmittance: [rows, stride] output, remaining transmittance.
    """
    for task in prange(shares.shape[0] - 1):
        blend_task(
            np.int64(task),
            splats,
            features,
            groups,
            starts,
            items,
            covers,
            wanted,
            tile_order,
            shares,
            size,
            background,
            limits,
            image,
            transmittance,
        )


@kernel
def blend_backward_task(
    task,
    splats,
    features,
    groups,
    starts,
    items,
    slots,
    covers,
    learnt,
    tile_order,
    shares,
    size,
    limits,
    image,
    transmittance,
    g_image,
    g_alpha,
    records,
):
    """Processes the tiles of one task of ``blend_backward``."""
    cap, stop = limits[1], limits[2]
    faintest = np.float32(log2(limits[0]))
    channels = GROUP * len(groups)
    columns = records.shape[1]
    tiles_x = (size[0] + TILE - 1) // TILE
    # State of a block: transmittance (negative for finished pixels), contribution of later entries,
    # and image gradients.
    step = lanes.COUNT * (2 + channels)
    state = np.empty(BLOCKS * step + lanes.COUNT, np.float32)
    base = lanes.aligned(state)
    weights = np.empty((BLOCKS + 1) * lanes.COUNT, np.float32)
    for turn in range(shares[task], shares[task + 1]):
        tile = tile_order[turn]
        y_first = (tile // tiles_x) * TILE
        x_first = (tile % tiles_x) * TILE
        copy_blocks(g_alpha, y_first, x_first, state, base, step, True)
        copy_blocks(transmittance, y_first, x_first, state, base + lanes.COUNT, step, True)
        for block in range(BLOCKS):
            at = base + block * step + lanes.COUNT
            lanes.store(state, at, ZERO - lanes.load(state, at) * lanes.load(state, at - lanes.COUNT))
        for channel in range(channels):
            copy_blocks(image[channel], y_first, x_first, state, base, step, True)
            copy_blocks(g_image[channel], y_first, x_first, state, base + lanes.COUNT * (2 + channel), step, True)
            for block in range(BLOCKS):
                place = base + block * step
                product = lanes.load(state, place) * lanes.load(state, place + lanes.COUNT * (2 + channel))
                lanes.store(state, place + lanes.COUNT, lanes.load(state, place + lanes.COUNT) + product)
        for block in range(BLOCKS):
            lanes.store(state, base + block * step, lanes.fill(ONE))
        end = starts[tile + 1]
        while end > starts[tile] and learnt[items[end - 1]] == 0:  # already part of the total
            end -= 1
        for entry in range(starts[tile], end):
            cover = covers[entry]
            left = cover
            fetch_ahead(entry, end, items, splats, features)
            lanes.prefetch_row(records, slots[min(entry + AHEAD, end - 1)])
            i = items[entry]
            splat = splats[i]
            a, b, c = splat[CONIC_A] * HALF_LOG2_E, splat[CONIC_B] * (TWO * HALF_LOG2_E), splat[CONIC_C] * HALF_LOG2_E
            log_opacity = splat[LOG_OPACITY]
            left_x = lanes.block_columns() + (np.float32(x_first) + HALF - splat[MEAN_X])
            top_y = lanes.block_rows() + (np.float32(y_first) + HALF - splat[MEAN_Y])
            if learnt[i] == 0:
                while left != np.uint64(0):
                    block = lanes.lowest_bit(left)
                    left = without_lowest_block(left)
                    dx = left_x + BLOCK_X[block]
                    dy = top_y + BLOCK_Y[block]
                    power = log_opacity - (a * dx * dx + (b * dx + c * dy) * dy)
                    place = base + block * step
                    before = lanes.load(state, place)
                    dot = lanes.load(state, place + 2 * lanes.COUNT) * features[i, 0]
                    for channel in range(1, channels):
                        dot += lanes.load(state, place + lanes.COUNT * (2 + channel)) * features[i, channel]
                    weight = lanes.minimum(lanes.exp2(power), lanes.fill(cap)) * before
                    after = before - weight
                    drawn = (power >= faintest) & (after >= stop)
                    stopped = (power >= faintest) & (after < stop)
                    weight = lanes.choose(drawn, weight, lanes.fill(ZERO))
                    behind = lanes.load(state, place + lanes.COUNT)
                    lanes.store(
                        state,
                        place,
                        lanes.choose(stopped, ZERO - lanes.magnitude(before), lanes.choose(drawn, after, before)),
                    )
                    lanes.store(state, place + lanes.COUNT, behind - weight * dot)
                continue
            s = lanes.fill(ZERO)
            sx = sy = sxx = sxy = syy = s
            t0 = t1 = t2 = t3 = s
            while left != np.uint64(0):
                block = lanes.lowest_bit(left)
                left = without_lowest_block(left)
                dx = left_x + BLOCK_X[block]
                dy = top_y + BLOCK_Y[block]
                power = log_opacity - (a * dx * dx + (b * dx + c * dy) * dy)
                place = base + block * step
                before = lanes.load(state, place)
                behind = lanes.load(state, place + lanes.COUNT)
                g0 = lanes.load(state, place + 2 * lanes.COUNT)
                g1 = lanes.load(state, place + 3 * lanes.COUNT)
                g2 = lanes.load(state, place + 4 * lanes.COUNT)
                g3 = lanes.load(state, place + 5 * lanes.COUNT)
                dot = g0 * features[i, 0] + g1 * features[i, 1] + g2 * features[i, 2] + g3 * features[i, 3]
                for group in range(GROUP, channels, GROUP):
                    at = place + lanes.COUNT * (2 + group)
                    dot += lanes.load(state, at) * features[i, group]
                    dot += lanes.load(state, at + lanes.COUNT) * features[i, group + 1]
                    dot += lanes.load(state, at + 2 * lanes.COUNT) * features[i, group + 2]
                    dot += lanes.load(state, at + 3 * lanes.COUNT) * features[i, group + 3]
                alpha = lanes.minimum(lanes.exp2(power), lanes.fill(cap))
                weight = alpha * before
                after = before - weight
                drawn = (power >= faintest) & (after >= stop)
                stopped = (power >= faintest) & (after < stop)
                weight = lanes.choose(drawn, weight, lanes.fill(ZERO))
                behind = behind - weight * dot
                lanes.store(
                    state,
                    place,
                    lanes.choose(stopped, ZERO - lanes.magnitude(before), lanes.choose(drawn, after, before)),
                )
                lanes.store(state, place + lanes.COUNT, behind)
                g = weight * dot - behind * (alpha / (ONE - alpha))
                g = lanes.choose(drawn & (alpha < cap), g, lanes.fill(ZERO))
                gx, gy = g * dx, g * dy
                s += g
                sx += gx
                sy += gy
                sxx += gx * dx
                sxy += gx * dy
                syy += gy * dy
                t0 += weight * g0
                t1 += weight * g1
                t2 += weight * g2
                t3 += weight * g3
                if channels > GROUP:
                    lanes.store(weights, block * lanes.COUNT, weight)
            record = slots[entry] * columns
            lanes.store(records, record, lanes.sums_of((s, sx, sy, sxx, sxy, syy, t0, t1, t2, t3)))
            for channel in range(GROUP, channels):
                total = lanes.fill(ZERO)
                left = cover
                while left != np.uint64(0):
                    block = lanes.lowest_bit(left)
                    left = without_lowest_block(left)
                    g0 = lanes.load(state, base + block * step + lanes.COUNT * (2 + channel))
                    total += lanes.load(weights, block * lanes.COUNT) * g0
                records[slots[entry], FEATURES + channel] = lanes.sum_of(total)


@parallel_kernel
def blend_backward(
    splats,
    features,
    groups,
    starts,
    items,
    slots,
    covers,
    learnt,
    tile_order,
    shares,
    size,
    limits,
    image,
    transmittance,
    g_image,
    g_alpha,
    records,
):
    """Computes the gradients of every entry, i.e. of every Gaussian–tile pair.

    Like the forward pass, the backward pass runs front to back. Later entries affect the gradients
    only through the product of their blended features and the image gradient. For each pixel, this
    product is a single number: the total of all entries minus the contribution of all entries so
    far.

    Args:
        splats, features, groups, starts, items, tile_order, shares, size, limits: see ``blend``.
        slots: [entries] pair of each entry, i.e. its row in ``records``.
        covers: [entries] block masks, as updated by ``blend``.
        learnt: [N] uint8 mask. If the value is 0, the Gaussian needs no gradient, and its records
            are not written.
        image, transmittance: outputs of ``blend``.
        g_image: [C, rows, stride] dL/dimage.
        g_alpha: [rows, stride] dL/dalpha, where alpha = 1 - transmittance.
        records: [pairs, multiple of ``Lanes``] float32 output; see the column constants above.
    """
    for task in prange(shares.shape[0] - 1):
        blend_backward_task(
            np.int64(task),
            splats,
            features,
            groups,
            starts,
            items,
            slots,
            covers,
            learnt,
            tile_order,
            shares,
            size,
            limits,
            image,
            transmittance,
            g_image,
            g_alpha,
            records,
        )
