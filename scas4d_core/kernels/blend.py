"""Front-to-back blending of tiles, forward and backward. Twin: ``rasterize.twin.render``.

Loops run over fixed rows of 16 pixels so that LLVM turns each statement into one vector instruction.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from scas4d_core.kernels.jit import HALF, ONE, TWO, ZERO, inline, kernel, parallel_kernel
from scas4d_core.kernels.projection import CONIC_A, CONIC_B, CONIC_C, MEAN_X, MEAN_Y, OPACITY, REACH, TILE

# Columns of a pair's gradient record: sums over the tile's pixels of dL/dpower times the monomials of the offset
# (dx, dy), then the features.
SUM_1, SUM_X, SUM_Y, SUM_XX, SUM_XY, SUM_YY, FEATURES = range(7)

GROUP = 4
"""Channels are blended four at a time, written out: the compiler vectorizes along the pixels of a row only then."""

EXP_LOWEST = np.float32(-6.0)
"""exp is needed for powers down to log(1/255) = -5.55 only: fainter is outside the support."""


@inline
def exp_in_support(power):
    """exp(power) for power in [-6, 0], relative error 3e-7: a polynomial on power/8, squared three times."""
    x = max(power, EXP_LOWEST) * np.float32(0.125)
    y = np.float32(1.0 / 5040.0)
    y = y * x + np.float32(1.0 / 720.0)
    y = y * x + np.float32(1.0 / 120.0)
    y = y * x + np.float32(1.0 / 24.0)
    y = y * x + np.float32(1.0 / 6.0)
    y = y * x + HALF
    y = y * x + ONE
    y = y * x + ONE
    y = y * y
    y = y * y
    return y * y


@inline
def rows_reached(splat, top):
    """First and last (exclusive) row of a tile that the support's box meets."""
    determinant = splat[CONIC_A] * splat[CONIC_C] - splat[CONIC_B] * splat[CONIC_B]
    half = np.float32(np.sqrt(splat[REACH] * splat[CONIC_A] / max(determinant, np.float32(1e-30)))) + np.float32(0.01)
    first = int(max(np.floor(splat[MEAN_Y] - half - HALF - top), ZERO))
    last = int(min(np.ceil(splat[MEAN_Y] + half + HALF - top), np.float32(TILE)))
    return first, max(first, last)


@inline
def row_is_reached(a, b, c, reach, slope, low_x, dy):
    """Whether the support meets a row of 16 pixel centres that begins ``low_x`` right of the Gaussian's centre.

    ``slope`` is -b/a: along the row, the quadratic form is smallest at slope dy. ``reach`` allows for rounding.
    """
    dx = min(max(slope * dy, low_x), low_x + np.float32(TILE - 1))
    return a * dx * dx + TWO * b * dx * dy + c * dy * dy <= reach


@kernel
def blend_task(
    task, splats, features, groups, starts, items, tile_order, tasks, size, background, limits, image, rest, depths_used
):
    """The tiles of one task of ``blend``. Scratch arrays have constant shapes here, see ``groups``."""
    floor, cap, stop = limits[0], limits[1], limits[2]
    channels = GROUP * len(groups)
    tiles_x = (size[0] + TILE - 1) // TILE
    # One array per purpose of the whole tile: with a single base the compiler needs no overlap checks.
    state = np.empty((TILE, 2 + channels, TILE), np.float32)  # per row: light still alive, light left, colours
    weight = np.empty(TILE, np.float32)
    for turn in range(task, tile_order.shape[0], tasks):
        tile = tile_order[turn]
        x0 = np.float32((tile % tiles_x) * TILE) + HALF
        top = np.float32((tile // tiles_x) * TILE)
        state[:, :2] = ONE
        state[:, 2:] = ZERO
        used = 0
        for entry in range(starts[tile], starts[tile + 1]):
            i = items[entry]
            used += 1
            splat = splats[i]
            mx, my = splat[MEAN_X], splat[MEAN_Y]
            a, b, c, opacity = splat[CONIC_A], splat[CONIC_B], splat[CONIC_C], splat[OPACITY]
            reach, slope = splat[REACH] * np.float32(1.0001) + np.float32(1e-4), -b / a
            first, last = rows_reached(splat, top)
            for row in range(first, last):
                dy = top + np.float32(row) + HALF - my
                if not row_is_reached(a, b, c, reach, slope, x0 - mx, dy):
                    continue
                lanes = state[row]
                along = b * dy
                constant = HALF * c * dy * dy
                for k in range(TILE):
                    dx = x0 + np.float32(k) - mx
                    power = -(HALF * a * dx * dx + along * dx + constant)
                    alpha = min(opacity * exp_in_support(power), cap)
                    alpha = alpha if (alpha >= floor) & (power >= EXP_LOWEST) else ZERO
                    before = lanes[0, k]
                    after = before * (ONE - alpha)
                    goes_on = after >= stop
                    weight[k] = alpha * before if goes_on else ZERO
                    lanes[1, k] = after if goes_on else lanes[1, k]
                    lanes[0, k] = after if goes_on else ZERO
                for group in range(2, 2 + channels, GROUP):
                    f0, f1 = features[i, group - 2], features[i, group - 1]
                    f2, f3 = features[i, group], features[i, group + 1]
                    for k in range(TILE):
                        lanes[group, k] += weight[k] * f0
                        lanes[group + 1, k] += weight[k] * f1
                        lanes[group + 2, k] += weight[k] * f2
                        lanes[group + 3, k] += weight[k] * f3
            if used % 16 == 0:
                brightest = ZERO
                for row in range(TILE):
                    for k in range(TILE):
                        brightest = max(brightest, state[row, 0, k])
                if brightest == ZERO:
                    break
        depths_used[tile] = used
        y_first = (tile // tiles_x) * TILE
        x_first = (tile % tiles_x) * TILE
        for row in range(TILE):
            for k in range(TILE):
                rest[y_first + row, x_first + k] = state[row, 1, k]
            for channel in range(channels):
                behind = background[channel]
                for k in range(TILE):
                    image[channel, y_first + row, x_first + k] = state[row, 2 + channel, k] + state[row, 1, k] * behind


@parallel_kernel
def blend(
    splats, features, groups, starts, items, tile_order, tasks, size, background, limits, image, rest, depths_used
):
    """Blend every tile front to back.

    Args:
        splats: [N, 8]; features: [N, C] float32, C a multiple of 4; starts [tiles + 1], items: tile lists.
        groups: a tuple of C/4 numbers, whose length the compiler knows: only with scratch arrays of constant shape
            does it see that their rows do not overlap (measured: 4 to 10 times faster).
        tile_order: [tiles] int64, tiles dealt to ``tasks`` in this order. size: (width, height) in pixels.
        background: [C]. limits: [6], the fields of ``Limits``.
        image: out [C, rows, stride] float32, padded to whole tiles. rest: out [rows, stride] transmittance left.
        depths_used: out [tiles] int32, list entries looked at until every pixel was finished.
    """
    for task in prange(tasks):
        blend_task(
            task,
            splats,
            features,
            groups,
            starts,
            items,
            tile_order,
            tasks,
            size,
            background,
            limits,
            image,
            rest,
            depths_used,
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
    tile_order,
    tasks,
    size,
    limits,
    image,
    rest,
    depths_used,
    g_image,
    g_alpha,
    records,
):
    """The tiles of one task of ``blend_backward``. Scratch arrays have constant shapes here, see ``groups``."""
    floor, cap, stop = limits[0], limits[1], limits[2]
    channels = GROUP * len(groups)
    tiles_x = (size[0] + TILE - 1) // TILE
    state = np.empty((TILE, 2 + channels, TILE), np.float32)  # per row: light alive, remaining, gradients
    sums = np.empty((5 + channels, TILE), np.float32)  # over rows: 1, dy, dy^2; this row: dot, weight; features
    for turn in range(task, tile_order.shape[0], tasks):
        tile = tile_order[turn]
        y_first = (tile // tiles_x) * TILE
        x_first = (tile % tiles_x) * TILE
        x0 = np.float32(x_first) + HALF
        top = np.float32(y_first)
        for row in range(TILE):
            for k in range(TILE):
                state[row, 0, k] = ONE
                state[row, 1, k] = -g_alpha[y_first + row, x_first + k] * rest[y_first + row, x_first + k]
            for channel in range(channels):
                for k in range(TILE):
                    g = g_image[channel, y_first + row, x_first + k]
                    state[row, 2 + channel, k] = g
                    state[row, 1, k] += g * image[channel, y_first + row, x_first + k]
        end = starts[tile] + depths_used[tile]
        for entry in range(starts[tile], end):
            i = items[entry]
            splat = splats[i]
            mx, my = splat[MEAN_X], splat[MEAN_Y]
            a, b, c, opacity = splat[CONIC_A], splat[CONIC_B], splat[CONIC_C], splat[OPACITY]
            reach, slope = splat[REACH] * np.float32(1.0001) + np.float32(1e-4), -b / a
            first, last = rows_reached(splat, top)
            sums[:] = ZERO
            for row in range(first, last):
                dy = top + np.float32(row) + HALF - my
                if not row_is_reached(a, b, c, reach, slope, x0 - mx, dy):
                    continue
                lanes = state[row]
                along = b * dy
                constant = HALF * c * dy * dy
                for k in range(TILE):
                    sums[3, k] = ZERO
                for group in range(2, 2 + channels, GROUP):
                    f0, f1 = features[i, group - 2], features[i, group - 1]
                    f2, f3 = features[i, group], features[i, group + 1]
                    for k in range(TILE):
                        sums[3, k] += (
                            f0 * lanes[group, k]
                            + f1 * lanes[group + 1, k]
                            + f2 * lanes[group + 2, k]
                            + f3 * lanes[group + 3, k]
                        )
                for k in range(TILE):
                    dx = x0 + np.float32(k) - mx
                    power = -(HALF * a * dx * dx + along * dx + constant)
                    free = opacity * exp_in_support(power)
                    alpha = min(free, cap)
                    alpha = alpha if (alpha >= floor) & (power >= EXP_LOWEST) else ZERO
                    before = lanes[0, k]
                    after = before * (ONE - alpha)
                    goes_on = after >= stop
                    weight = alpha * before if goes_on else ZERO
                    dot = sums[3, k]
                    behind = lanes[1, k] - weight * dot
                    g = alpha * (before * dot - behind / (ONE - alpha))
                    g = g if goes_on & (free < cap) else ZERO
                    lanes[1, k] = behind
                    lanes[0, k] = after if goes_on else ZERO
                    sums[0, k] += g
                    sums[1, k] += g * dy
                    sums[2, k] += g * dy * dy
                    sums[4, k] = weight
                for group in range(2, 2 + channels, GROUP):
                    for k in range(TILE):
                        sums[group + 3, k] += sums[4, k] * lanes[group, k]
                        sums[group + 4, k] += sums[4, k] * lanes[group + 1, k]
                        sums[group + 5, k] += sums[4, k] * lanes[group + 2, k]
                        sums[group + 6, k] += sums[4, k] * lanes[group + 3, k]
            s0 = sx = sy = sxx = sxy = syy = ZERO
            for k in range(TILE):
                dx = x0 + np.float32(k) - mx
                s0 += sums[0, k]
                sx += sums[0, k] * dx
                sy += sums[1, k]
                sxx += sums[0, k] * dx * dx
                sxy += sums[1, k] * dx
                syy += sums[2, k]
            record = records[slots[entry]]
            record[SUM_1] = s0
            record[SUM_X] = sx
            record[SUM_Y] = sy
            record[SUM_XX] = sxx
            record[SUM_XY] = sxy
            record[SUM_YY] = syy
            for channel in range(channels):
                total = ZERO
                for k in range(TILE):
                    total += sums[5 + channel, k]
                record[FEATURES + channel] = total
        for entry in range(end, starts[tile + 1]):
            records[slots[entry]] = ZERO


@parallel_kernel
def blend_backward(
    splats,
    features,
    groups,
    starts,
    items,
    slots,
    tile_order,
    tasks,
    size,
    limits,
    image,
    rest,
    depths_used,
    g_image,
    g_alpha,
    records,
):
    """Gradients of every pair of Gaussian and tile.

    Front to back, as forward: what lies behind entry i enters only through its product with the incoming gradient,
    one number a pixel, which is what remains of the total after the entries so far.

    Args:
        g_image: [C, rows, stride] dL/dimage. g_alpha: [rows, stride] dL/dalpha, alpha = 1 - rest.
        records: out [pairs, 6 + C] float32, columns above.
    """
    for task in prange(tasks):
        blend_backward_task(
            task,
            splats,
            features,
            groups,
            starts,
            items,
            slots,
            tile_order,
            tasks,
            size,
            limits,
            image,
            rest,
            depths_used,
            g_image,
            g_alpha,
            records,
        )
