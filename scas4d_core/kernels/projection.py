"""EWA projection of Gaussians to the image plane of a camera, and its backward pass.

A camera is represented by ``pose`` [3, 4] float32 (world to camera, OpenCV axes) and ``lens`` [6] float32
(fx, fy, cx, cy, width, height) in pixels, with pixel centres at +0.5.

Gaussians with invalid values are not rendered, because they would corrupt every pixel that they
cover. Gradients that overflow are discarded. Both events are counted; see ``guards``. The reference
implementation is ``engines.torch.rasterizer``.
"""

from __future__ import annotations

from math import log2

import numpy as np
from numba import prange

from scas4d_core.guards import FEATURE_CEILING, FOOTPRINT_CEILING, GRADIENT_NOT_FINITE, NOT_FINITE
from scas4d_core.kernels import lanes
from scas4d_core.kernels.jit import HALF, ONE, TWO, ZERO, inline, kernel, parallel_kernel

TILE = 32
"""Side length of a tile in pixels. Its 8×8 blocks of 4×4 pixels fit into a 64-bit mask, and its state fits into the L1
cache."""

CHUNK = 256
"""Number of Gaussians per task, a compromise between overhead and load balance."""

AHEAD = 16
"""Prefetch distance in Gaussians. Prefetching pays off because the records of Gaussians are
scattered in memory."""

FARTHEST = np.float32(NOT_FINITE)
BRIGHTEST = np.float32(FEATURE_CEILING)
WIDEST = np.float32(FOOTPRINT_CEILING)
STEEPEST = np.float32(GRADIENT_NOT_FINITE)

COUNTED_GUARDS = ("not_finite", "footprint_ceiling")
"""Names of the guards that ``project`` counts."""
COUNTED_GUARDS_BACKWARD = ("gradient_not_finite",)
"""Names of the guards that ``project_backward`` counts."""

# Columns of ``splats`` [N, 16], the per-Gaussian data for later kernels. REACH is the squared Mahalanobis radius of the
# support. At a horizontal offset dx from the centre, the support extends over the vertical offsets (positive downwards)
# SLOPE dx ± sqrt(SPREAD (REACH - THIN dx²)). Its lowest point is at dx = LOWEST_X, the highest at -LOWEST_X.
MEAN_X, MEAN_Y, CONIC_A, CONIC_B, CONIC_C, OPACITY, REACH, DEPTH = range(8)
LOG_OPACITY, SLOPE, SPREAD, THIN, LOWEST_X = range(8, 13)
SPLAT_COLUMNS = 16


@inline
def tangents(u, v, lens, margin):
    """Clamps u = x/z and v = y/z for the Jacobian.

    Returns:
        The clamped u and v, and masks of the values of u and v within the bounds.
    """
    fx, fy, cx, cy, width, height = lens[0], lens[1], lens[2], lens[3], lens[4], lens[5]
    margin_x = margin * HALF * width / fx
    margin_y = margin * HALF * height / fy
    low_u, high_u = -(cx / fx + margin_x), (width - cx) / fx + margin_x
    low_v, high_v = -(cy / fy + margin_y), (height - cy) / fy + margin_y
    free_u, free_v = (u >= low_u) & (u <= high_u), (v >= low_v) & (v <= high_v)
    u = lanes.minimum(lanes.maximum(u, lanes.fill(low_u)), lanes.fill(high_u))
    v = lanes.minimum(lanes.maximum(v, lanes.fill(low_v)), lanes.fill(high_v))
    return u, v, free_u, free_v


@inline
def rotate_coordinate(pose, row, x, y, z):
    """Rotates vectors into the camera's axes and returns coordinate ``row`` of the result."""
    return x * pose[row, 0] + y * pose[row, 1] + z * pose[row, 2]


@inline
def sound_features(features, first):
    """Checks the features of sixteen Gaussians, starting at row ``first``.

    Returns:
        1 for Gaussians whose features are all finite and within bounds, 0 for all others.
    """
    columns = features.shape[1]
    sound = lanes.fill(ONE)
    total = lanes.fill(ZERO)
    for k in range(columns):
        total += lanes.magnitude(lanes.load(features, first * columns + lanes.COUNT * k))
    if lanes.any_of(lanes.choose(total <= BRIGHTEST, lanes.fill(ZERO), lanes.fill(ONE)) > ZERO):
        for k in range(columns):
            size = lanes.magnitude(lanes.gather(features, first * columns + k, columns))
            sound = lanes.choose(size <= BRIGHTEST, sound, lanes.fill(ZERO))
    return sound


@kernel
def project_group(first, means, factors, opacities, features, pose, lens, limits, splats, place, boxes, guard_counts):
    """Projects sixteen Gaussians, starting at row ``first``; see ``project``.

    Args:
        splats: output, starting at row ``place``.
        boxes: [5 · 16] output, tile ranges x0, y0, x1, y1 of each Gaussian, and number of tiles.
        guard_counts: [2] counts, to which the number of Gaussians that triggered each guard is
            added.
    """
    alpha_floor, low_pass, near, margin = limits[0], limits[3], limits[4], limits[5]
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    width, height = lens[4], lens[5]
    tiles_x = np.float32((int(width) + TILE - 1) // TILE)
    tiles_y = np.float32((int(height) + TILE - 1) // TILE)
    zero = lanes.fill(ZERO)
    px, py = lanes.gather(means, 3 * first, 3), lanes.gather(means, 3 * first + 1, 3)
    pz = lanes.gather(means, 3 * first + 2, 3)
    x = rotate_coordinate(pose, 0, px, py, pz) + pose[0, 3]
    y = rotate_coordinate(pose, 1, px, py, pz) + pose[1, 3]
    z = rotate_coordinate(pose, 2, px, py, pz) + pose[2, 3]
    inverse = lanes.fill(ONE) / z
    opacity = lanes.load(opacities, first)
    size = lanes.magnitude(px) + lanes.magnitude(py) + lanes.magnitude(pz) + lanes.magnitude(opacity)
    u, v, _, _ = tangents(x * inverse, y * inverse, lens, margin)
    sxx = syy = lanes.fill(low_pass)
    sxy = zero
    m00 = m01 = m02 = m10 = m11 = m12 = zero
    for k in range(3):
        f0 = lanes.gather(factors, 9 * first + k, 9)
        f1 = lanes.gather(factors, 9 * first + 3 + k, 9)
        f2 = lanes.gather(factors, 9 * first + 6 + k, 9)
        size = size + (lanes.magnitude(f0) + lanes.magnitude(f1) + lanes.magnitude(f2))
        a2 = rotate_coordinate(pose, 2, f0, f1, f2)
        m0 = fx * inverse * (rotate_coordinate(pose, 0, f0, f1, f2) - u * a2)
        m1 = fy * inverse * (rotate_coordinate(pose, 1, f0, f1, f2) - v * a2)
        sxx = sxx + m0 * m0
        sxy = sxy + m0 * m1
        syy = syy + m1 * m1
        m00, m01, m02 = m01, m02, m0
        m10, m11, m12 = m11, m12, m1
    # |m0 x m1|^2 + low_pass (...) - low_pass^2 avoids cancellation in sxx syy - sxy^2 for needle-shaped Gaussians.
    n0 = m01 * m12 - m02 * m11
    n1 = m02 * m10 - m00 * m12
    n2 = m00 * m11 - m01 * m10
    determinant = n0 * n0 + n1 * n1 + n2 * n2 + low_pass * (sxx + syy - low_pass)
    sound = lanes.choose(size <= FARTHEST, sound_features(features, first), zero)
    if lanes.any_of(sound <= ZERO):
        guard_counts[0] += lanes.count_of(sound <= ZERO)
    visible = (z >= near) & (opacity >= alpha_floor) & (sound > ZERO)
    drawable = (determinant > ZERO) & (determinant < WIDEST)
    lost = lanes.choose(drawable, zero, lanes.choose(visible, lanes.fill(ONE), zero))
    if lanes.any_of(lost > ZERO):
        guard_counts[1] += lanes.count_of(lost > ZERO)
    visible = visible & drawable
    mx = fx * x * inverse + cx
    my = fy * y * inverse + cy
    log_opacity = lanes.log2(opacity)
    reach = (log_opacity - np.float32(log2(alpha_floor))) * np.float32(1.3862943611198906)
    reach = lanes.maximum(reach, zero)
    half_x = lanes.square_root(reach * sxx)
    half_y = lanes.square_root(reach * syy)
    # Pixel centres are at +0.5. The centre of the first covered column is therefore at or to the
    # right of mx - half_x.
    left, right = mx - half_x - HALF, mx + half_x + HALF
    top, bottom = my - half_y - HALF, my + half_y + HALF
    visible = visible & (right > ZERO) & (left < width) & (bottom > ZERO) & (top < height)
    tile = np.float32(1.0 / TILE)
    x0 = lanes.choose(visible, lanes.floor(lanes.maximum(left, zero) * tile), zero)
    y0 = lanes.choose(visible, lanes.floor(lanes.maximum(top, zero) * tile), zero)
    x1 = lanes.minimum(lanes.floor(lanes.minimum(right, lanes.fill(width)) * tile) + ONE, lanes.fill(tiles_x))
    y1 = lanes.minimum(lanes.floor(lanes.minimum(bottom, lanes.fill(height)) * tile) + ONE, lanes.fill(tiles_y))
    x1, y1 = lanes.choose(visible, x1, zero), lanes.choose(visible, y1, zero)
    lanes.store(boxes, 0, x0)
    lanes.store(boxes, lanes.COUNT, y0)
    lanes.store(boxes, 2 * lanes.COUNT, x1)
    lanes.store(boxes, 3 * lanes.COUNT, y1)
    lanes.store(boxes, 4 * lanes.COUNT, (x1 - x0) * (y1 - y0))
    over = lanes.fill(ONE) / determinant
    thin = lanes.fill(ONE) / sxx
    rows = lanes.transposed(
        (
            mx, my, syy * over, (zero - sxy) * over, sxx * over, opacity, reach, z,
            log_opacity, sxy * thin, determinant * thin, thin, sxy * half_y / syy, zero, zero, zero,
        )
    )  # fmt: skip
    for k in range(lanes.COUNT):
        lanes.store(splats, SPLAT_COLUMNS * (place + k), rows[k])


@kernel
def padded_1(rows, first):
    """Returns sixteen values of an array, starting at ``first``, padded with zeros at the end of the array."""
    result = np.zeros(lanes.COUNT, np.float32)
    for k in range(min(lanes.COUNT, rows.shape[0] - first)):
        result[k] = rows[first + k]
    return result


@kernel
def padded_2(rows, first):
    """Returns sixteen rows of an array, starting at ``first``, padded with zeros at the end of the array."""
    result = np.zeros((lanes.COUNT, rows.shape[1]), np.float32)
    for k in range(min(lanes.COUNT, rows.shape[0] - first)):
        for column in range(rows.shape[1]):
            result[k, column] = rows[first + k, column]
    return result


@kernel
def padded_3(rows, first):
    """Returns sixteen 3×3 matrices of an array, starting at ``first``, padded with zeros at the end of the array."""
    result = np.zeros((lanes.COUNT, 3, 3), np.float32)
    for k in range(min(lanes.COUNT, rows.shape[0] - first)):
        for i in range(3):
            for j in range(3):
                result[k, i, j] = rows[first + k, i, j]
    return result


@kernel
def project_task(
    task, means, factors, opacities, features, pose, lens, limits, splats, rects, counts, guard_counts
):  # fmt: skip
    """Projects the Gaussians of one task of ``project``."""
    count = means.shape[0]
    guard_counts[task, 0] = guard_counts[task, 1] = 0
    boxes = np.empty(5 * lanes.COUNT, np.float32)
    for first in range(task * CHUNK, min(count, (task + 1) * CHUNK), lanes.COUNT):
        some = min(lanes.COUNT, count - first)
        place, m, f, o, c = first, means, factors, opacities, features
        if some < lanes.COUNT:
            place = 0
            m, f = padded_2(means, first), padded_3(factors, first)
            o, c = padded_1(opacities, first), padded_2(features, first)
        project_group(place, m, f, o, c, pose, lens, limits, splats, first, boxes, guard_counts[task])
        for k in range(some):
            for side in range(4):
                rects[first + k, side] = np.int32(boxes[side * lanes.COUNT + k])
            counts[first + k] = np.int32(boxes[4 * lanes.COUNT + k])


@parallel_kernel
def project(means, factors, opacities, features, pose, lens, limits, splats, rects, counts, guard_counts):
    """Projects N Gaussians, sixteen at a time.

    Args:
        means: [N, 3] float32 means in world coordinates.
        factors: [N, 3, 3] float32 covariance factors F, with Σ = F Fᵀ.
        opacities: [N] float32 opacities.
        features: [N, C] float32 features. The function only checks them for invalid values.
        pose, lens: camera; see the module docstring.
        limits: [6] float32 rasterizer constants, in the order of the ``Limits`` fields.
        splats: [N + 15 or more, 16] float32 output; see the column constants above.
        rects: [N, 4] int32 output, bounding box of each support in tiles: x0, y0, x1, y1
            (exclusive). The box of a culled Gaussian is empty.
        counts: [N] int32 output, number of tiles in each bounding box.
        guard_counts: [tasks of ``CHUNK``, 2] int64 output, number of Gaussians that triggered each guard in
            ``COUNTED_GUARDS``.
    """
    for task in prange((means.shape[0] + CHUNK - 1) // CHUNK):
        project_task(
            np.int64(task), means, factors, opacities, features, pose, lens, limits, splats, rects, counts, guard_counts
        )


@kernel
def project_backward_group(
    first, place, means, factors, pose, lens, limits, splats, sums, columns, depth_channel, g_means, g_factors,
    g_opacities, g_screen,
):  # fmt: skip
    """Backpropagates the gradients of sixteen Gaussians from the image to the world.

    For the other arguments, see ``project_backward``.

    Args:
        first: row of the first Gaussian in ``means`` and ``factors``.
        place: row of the first Gaussian in ``splats``.
        sums: [16, columns] sum of the records of each Gaussian over its pairs, followed by a flag:
            1 if the Gaussian has pairs, otherwise 0. If the gradient of the Gaussian overflows, the
            flag is cleared.
        g_means, g_factors, g_opacities, g_screen: outputs with sixteen rows.
    """
    margin = limits[5]
    fx, fy = lens[0], lens[1]
    zero = lanes.fill(ZERO)
    px, py = lanes.gather(means, 3 * first, 3), lanes.gather(means, 3 * first + 1, 3)
    pz = lanes.gather(means, 3 * first + 2, 3)
    x = rotate_coordinate(pose, 0, px, py, pz) + pose[0, 3]
    y = rotate_coordinate(pose, 1, px, py, pz) + pose[1, 3]
    z = rotate_coordinate(pose, 2, px, py, pz) + pose[2, 3]
    inverse = lanes.fill(ONE) / z
    u, v, free_u, free_v = tangents(x * inverse, y * inverse, lens, margin)
    row = SPLAT_COLUMNS * place
    a = lanes.gather(splats, row + CONIC_A, SPLAT_COLUMNS)
    b = lanes.gather(splats, row + CONIC_B, SPLAT_COLUMNS)
    c = lanes.gather(splats, row + CONIC_C, SPLAT_COLUMNS)
    seen = lanes.gather(sums, columns - 1, columns) > ZERO
    by_1, by_x, by_y = lanes.gather(sums, 0, columns), lanes.gather(sums, 1, columns), lanes.gather(sums, 2, columns)
    by_xx, by_xy, by_yy = lanes.gather(sums, 3, columns), lanes.gather(sums, 4, columns), lanes.gather(sums, 5, columns)
    g_depth = lanes.gather(sums, 6 + depth_channel, columns) if depth_channel >= 0 else zero
    opacity = lanes.gather(splats, row + OPACITY, SPLAT_COLUMNS)
    lanes.store(g_opacities, 0, lanes.choose(seen, by_1 / opacity, zero))
    g_x = lanes.choose(seen, a * by_x + b * by_y, zero)
    g_y = lanes.choose(seen, b * by_x + c * by_y, zero)
    lanes.scatter(g_screen, 0, 2, g_x)
    lanes.scatter(g_screen, 1, 2, g_y)
    # dL/dcov2d = -conic dL/dconic conic, with dL/dconic symmetric: [[ga, gb/2], [gb/2, gc]].
    ga, h, gc = by_xx * -HALF, by_xy * -HALF, by_yy * -HALF
    p00, p01 = a * ga + b * h, a * h + b * gc
    p10, p11 = b * ga + c * h, b * h + c * gc
    s00 = zero - (p00 * a + p01 * b)
    s01 = zero - (p00 * b + p01 * c)
    s11 = zero - (p10 * b + p11 * c)
    g_u = g_v = g_z = size = zero
    for k in range(3):
        f0 = lanes.gather(factors, 9 * first + k, 9)
        f1 = lanes.gather(factors, 9 * first + 3 + k, 9)
        f2 = lanes.gather(factors, 9 * first + 6 + k, 9)
        a2 = rotate_coordinate(pose, 2, f0, f1, f2)
        m0 = fx * inverse * (rotate_coordinate(pose, 0, f0, f1, f2) - u * a2)
        m1 = fy * inverse * (rotate_coordinate(pose, 1, f0, f1, f2) - v * a2)
        gm0 = TWO * (s00 * m0 + s01 * m1)
        gm1 = TWO * (s01 * m0 + s11 * m1)
        ga0 = fx * inverse * gm0
        ga1 = fy * inverse * gm1
        ga2 = zero - (u * ga0 + v * ga1)
        g_u = g_u - ga0 * a2
        g_v = g_v - ga1 * a2
        g_z = g_z - (gm0 * m0 + gm1 * m1) * inverse
        for j in range(3):
            g = ga0 * pose[0, j] + ga1 * pose[1, j] + ga2 * pose[2, j]
            size = size + lanes.magnitude(g)
            lanes.scatter(g_factors, 3 * j + k, 9, lanes.choose(seen, g, zero))
    # Clamped tangents are treated as constants, but the projected mean always gets a gradient.
    g_u = lanes.choose(free_u, g_u, zero) * inverse
    g_v = lanes.choose(free_v, g_v, zero) * inverse
    gx = fx * inverse * g_x + g_u
    gy = fy * inverse * g_y + g_v
    gz = g_z + g_depth - inverse * (x * gx + y * gy)
    for k in range(3):
        g = gx * pose[0, k] + gy * pose[1, k] + gz * pose[2, k]
        size = size + lanes.magnitude(g)
        lanes.scatter(g_means, k, 3, lanes.choose(seen, g, zero))
    lost = lanes.choose(size <= STEEPEST, zero, lanes.choose(seen, lanes.fill(ONE), zero))
    if lanes.any_of(lost > ZERO):
        for lane in range(lanes.COUNT):
            steep = np.float32(0.0)
            for k in range(9):
                steep += abs(g_factors[lane, k // 3, k % 3])
            for k in range(3):
                steep += abs(g_means[lane, k])
            if not steep <= STEEPEST:
                sums[lane, columns - 1] = ZERO
                for k in range(9):
                    g_factors[lane, k // 3, k % 3] = ZERO
                for k in range(3):
                    g_means[lane, k] = ZERO
                g_screen[lane, 0] = g_screen[lane, 1] = ZERO
                g_opacities[lane] = ZERO


@kernel
def clear_steep_gradients(sums, counts, first, some, used):
    """Clears the sums and flags of all Gaussians whose sums exceed ``STEEPEST`` or are NaN."""
    for k in range(some):
        steep = ZERO
        for column in range(used):
            steep += abs(sums[k, column])
        if counts[first + k] > 0 and not steep <= STEEPEST:
            for column in range(sums.shape[1]):
                sums[k, column] = ZERO


@kernel
def project_backward_task(
    task, means, factors, pose, lens, limits, splats, counts, firsts, records, depth_channel, rows, g_means, g_factors,
    g_opacities, g_features, g_screen, guard_counts,
):  # fmt: skip
    """Backpropagates the gradients of the Gaussians of one task of ``project_backward``."""
    channels = g_features.shape[1]
    columns = records.shape[1]
    count = means.shape[0]
    sums = np.empty((lanes.COUNT, columns + 1), np.float32)
    gm, gf = np.empty((lanes.COUNT, 3), np.float32), np.empty((lanes.COUNT, 3, 3), np.float32)
    go, gs = np.empty(lanes.COUNT, np.float32), np.empty((lanes.COUNT, 2), np.float32)
    guard_counts[task, 0] = 0
    for first in range(task * CHUNK, min(count, (task + 1) * CHUNK), lanes.COUNT):
        some = min(lanes.COUNT, count - first)
        for k in range(lanes.COUNT):
            sums[k, columns] = ZERO
        worst = lanes.fill(ZERO)
        for k in range(some):
            i = first + k
            sums[k, columns] = ONE if counts[i] > 0 else ZERO
            ahead = min(i + AHEAD, count - 1)
            if counts[ahead] > 0:
                lanes.prefetch_row(records, firsts[ahead])
            for column in range(0, columns, lanes.COUNT):
                total = lanes.fill(ZERO)
                for pair in range(firsts[i], firsts[i] + counts[i]):
                    total += lanes.load(records, pair * columns + column)
                lanes.store(sums, k * (columns + 1) + column, total)
                worst += lanes.magnitude(lanes.only_first(total, 6 + channels - column))
        steep = not lanes.sum_of(worst) <= STEEPEST
        if steep:
            clear_steep_gradients(sums, counts, first, some, 6 + channels)
        place, m, f = first, means, factors
        if some < lanes.COUNT:
            place, m, f = 0, padded_2(means, first), padded_3(factors, first)
        project_backward_group(
            place, first, m, f, pose, lens, limits, splats, sums, columns + 1, depth_channel, gm, gf, go, gs
        )
        for k in range(some):
            if counts[first + k] > 0 and sums[k, columns] == ZERO:
                for channel in range(channels):
                    sums[k, 6 + channel] = ZERO
                guard_counts[task, 0] += 1
            row = rows[first + k]
            for column in range(9):
                g_factors[row, column // 3, column % 3] = gf[k, column // 3, column % 3]
            for column in range(3):
                g_means[row, column] = gm[k, column]
            g_opacities[row] = go[k]
            for channel in range(channels):
                g_features[row, channel] = sums[k, 6 + channel]
            g_screen[row, 0], g_screen[row, 1] = gs[k, 0], gs[k, 1]


@parallel_kernel
def project_backward(
    means,
    factors,
    pose,
    lens,
    limits,
    splats,
    counts,
    firsts,
    records,
    depth_channel,
    rows,
    g_means,
    g_factors,
    g_opacities,
    g_features,
    g_screen,
    guard_counts,
):
    """Backpropagates gradients from the image to the Gaussians in the world.

    The gradient records of a Gaussian are first summed over its pairs, in a fixed order. Sixteen
    Gaussians are processed at a time. The gradients of culled Gaussians are 0.

    Args:
        means, factors, pose, lens, limits, splats: see ``project``.
        counts: [N] number of pairs of each Gaussian.
        firsts: [N] first pair of each Gaussian.
        records: [pairs, multiple of ``Lanes``] gradient records from ``blend_backward``.
        depth_channel: feature channel that contains the depth of the mean, or -1.
        rows: [N] int64 rows of the outputs that are written. All other rows remain unchanged.
        g_means: [≥ N, 3] float32 output.
        g_factors: [≥ N, 3, 3] float32 output.
        g_opacities: [≥ N] float32 output.
        g_features: [≥ N, C] float32 output.
        g_screen: [≥ N, 2] float32 output, gradient of the projected mean per pixel, which density control uses.
        guard_counts: [tasks of ``CHUNK``, 1] int64 output, number of Gaussians that triggered the guard in
            ``COUNTED_GUARDS_BACKWARD``.
    """
    for task in prange((means.shape[0] + CHUNK - 1) // CHUNK):
        project_backward_task(
            np.int64(task), means, factors, pose, lens, limits, splats, counts, firsts, records, depth_channel, rows,
            g_means, g_factors, g_opacities, g_features, g_screen, guard_counts,
        )  # fmt: skip
