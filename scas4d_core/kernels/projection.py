"""EWA projection of Gaussians into a camera, and its backward. Twin: ``rasterize.twin.project``.

A camera enters as ``pose`` [3, 4] float32 (world to camera, OpenCV axes) and ``lens`` [6] float32
(fx, fy, cx, cy, width, height) in pixels; pixel centres at +0.5.
"""

from __future__ import annotations

from math import log, log2, sqrt

import numpy as np
from numba import prange

from scas4d_core.kernels.jit import HALF, ONE, TWO, ZERO, inline, kernel, parallel_kernel

TILE = 32
"""Pixels along the side of a tile: 8 by 8 blocks of 4 by 4, a bit each in 64; their state fits into the first cache."""

CHUNK = 256
"""Gaussians a task: enough work for a thread, few enough for balance."""

# Columns of ``splats`` [N, 16], what later kernels read of a Gaussian. REACH is the support's squared Mahalanobis
# radius. At a column dx right of the centre, the support is at SLOPE dx ± sqrt(SPREAD (REACH - THIN dx²)) below it; it
# is lowest at dx = LOWEST_X, highest at -LOWEST_X.
MEAN_X, MEAN_Y, CONIC_A, CONIC_B, CONIC_C, OPACITY, REACH, DEPTH = range(8)
LOG_OPACITY, SLOPE, SPREAD, THIN, LOWEST_X = range(8, 13)
SPLAT_COLUMNS = 16


@inline
def tangents(x, y, z, lens, margin):
    """x/z and y/z, clamped for the Jacobian, and whether each is inside (1) or clamped (0)."""
    fx, fy, cx, cy, width, height = lens[0], lens[1], lens[2], lens[3], lens[4], lens[5]
    margin_x = margin * HALF * width / fx
    margin_y = margin * HALF * height / fy
    u = x / z
    v = y / z
    low_u, high_u = -(cx / fx + margin_x), (width - cx) / fx + margin_x
    low_v, high_v = -(cy / fy + margin_y), (height - cy) / fy + margin_y
    free_u = ONE if (u >= low_u and u <= high_u) else ZERO
    free_v = ONE if (v >= low_v and v <= high_v) else ZERO
    return min(max(u, low_u), high_u), min(max(v, low_v), high_v), free_u, free_v


@parallel_kernel
def project(means, factors, opacities, pose, lens, limits, splats, rects, counts):
    """Project N Gaussians.

    Args:
        means: [N, 3] float32 world. factors: [N, 3, 3] float32, Σ = F Fᵀ. opacities: [N] float32.
        pose, lens: the camera. limits: [6] float32, the fields of ``Limits`` in order.
        splats: out [N, 16] float32, columns above.
        rects: out [N, 4] int32, tiles x0, y0, x1, y1 (exclusive) of the support's box; empty where culled.
        counts: out [N] int32, tiles in the box.
    """
    alpha_floor, low_pass, near, margin = limits[0], limits[3], limits[4], limits[5]
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    width, height = lens[4], lens[5]
    tiles_x = (int(width) + TILE - 1) // TILE
    tiles_y = (int(height) + TILE - 1) // TILE
    count = means.shape[0]
    for task in prange((count + CHUNK - 1) // CHUNK):
        m = np.empty((2, 3), np.float32)
        for i in range(task * CHUNK, min(count, (task + 1) * CHUNK)):
            counts[i] = 0
            rects[i, 0] = rects[i, 1] = rects[i, 2] = rects[i, 3] = 0
            px, py, pz = means[i, 0], means[i, 1], means[i, 2]
            x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]
            y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]
            z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
            splats[i, DEPTH] = z
            opacity = opacities[i]
            if not (z >= near) or not (opacity >= alpha_floor):
                continue
            u, v, _, _ = tangents(x, y, z, lens, margin)
            for k in range(3):
                a0 = pose[0, 0] * factors[i, 0, k] + pose[0, 1] * factors[i, 1, k] + pose[0, 2] * factors[i, 2, k]
                a1 = pose[1, 0] * factors[i, 0, k] + pose[1, 1] * factors[i, 1, k] + pose[1, 2] * factors[i, 2, k]
                a2 = pose[2, 0] * factors[i, 0, k] + pose[2, 1] * factors[i, 1, k] + pose[2, 2] * factors[i, 2, k]
                m[0, k] = fx / z * (a0 - u * a2)
                m[1, k] = fy / z * (a1 - v * a2)
            sxx = m[0, 0] * m[0, 0] + m[0, 1] * m[0, 1] + m[0, 2] * m[0, 2] + low_pass
            sxy = m[0, 0] * m[1, 0] + m[0, 1] * m[1, 1] + m[0, 2] * m[1, 2]
            syy = m[1, 0] * m[1, 0] + m[1, 1] * m[1, 1] + m[1, 2] * m[1, 2] + low_pass
            # |m0 x m1|^2 + low_pass (...) - low_pass^2 without the cancellation of sxx syy - sxy^2 for needles.
            n0 = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
            n1 = m[0, 2] * m[1, 0] - m[0, 0] * m[1, 2]
            n2 = m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]
            determinant = n0 * n0 + n1 * n1 + n2 * n2 + low_pass * (sxx + syy - low_pass)
            if not (determinant > ZERO) or not (determinant < np.float32(1e30)):
                continue
            mx = fx * x / z + cx
            my = fy * y / z + cy
            reach = np.float32(TWO * log(opacity / alpha_floor))
            half_x = np.float32(sqrt(reach * sxx))
            half_y = np.float32(sqrt(reach * syy))
            # Pixel centres lie at +0.5: the first covered column has centre >= mx - half_x.
            left, right = mx - half_x - HALF, mx + half_x + HALF
            top, bottom = my - half_y - HALF, my + half_y + HALF
            if not (right > ZERO and left < width and bottom > ZERO and top < height):
                continue
            x0 = int(max(left, ZERO)) // TILE
            y0 = int(max(top, ZERO)) // TILE
            x1 = min(int(min(right, width)) // TILE + 1, tiles_x)
            y1 = min(int(min(bottom, height)) // TILE + 1, tiles_y)
            splats[i, MEAN_X], splats[i, MEAN_Y] = mx, my
            splats[i, CONIC_A] = syy / determinant
            splats[i, CONIC_B] = -sxy / determinant
            splats[i, CONIC_C] = sxx / determinant
            splats[i, OPACITY], splats[i, REACH] = opacity, reach
            splats[i, LOG_OPACITY] = np.float32(log2(opacity))
            splats[i, SLOPE], splats[i, SPREAD] = sxy / sxx, determinant / sxx
            splats[i, THIN] = ONE / sxx
            splats[i, LOWEST_X] = sxy * half_y / syy
            rects[i, 0], rects[i, 1], rects[i, 2], rects[i, 3] = x0, y0, x1, y1
            counts[i] = (x1 - x0) * (y1 - y0)


@kernel
def project_backward_one(i, means, factors, pose, lens, limits, splat, g_mean, g_conic, g_depth, g_means, g_factors):
    """Carry one Gaussian's gradients from the picture to the world; see ``project_backward``."""
    margin = limits[5]
    fx, fy = lens[0], lens[1]
    px, py, pz = means[i, 0], means[i, 1], means[i, 2]
    x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]
    y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]
    z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
    u, v, free_u, free_v = tangents(x, y, z, lens, margin)
    inverse = ONE / z
    a, b, c = splat[CONIC_A], splat[CONIC_B], splat[CONIC_C]
    ga, gb, gc = g_conic[0], g_conic[1], g_conic[2]
    # dL/dcov2d = -conic dL/dconic conic, with dL/dconic symmetric: [[ga, gb/2], [gb/2, gc]].
    h = HALF * gb
    p00, p01 = a * ga + b * h, a * h + b * gc
    p10, p11 = b * ga + c * h, b * h + c * gc
    s00 = -(p00 * a + p01 * b)
    s01 = -(p00 * b + p01 * c)
    s11 = -(p10 * b + p11 * c)
    g_u = ZERO
    g_v = ZERO
    g_z = ZERO
    for k in range(3):
        f0, f1, f2 = factors[i, 0, k], factors[i, 1, k], factors[i, 2, k]
        a0 = pose[0, 0] * f0 + pose[0, 1] * f1 + pose[0, 2] * f2
        a1 = pose[1, 0] * f0 + pose[1, 1] * f1 + pose[1, 2] * f2
        a2 = pose[2, 0] * f0 + pose[2, 1] * f1 + pose[2, 2] * f2
        m0 = fx * inverse * (a0 - u * a2)
        m1 = fy * inverse * (a1 - v * a2)
        gm0 = TWO * (s00 * m0 + s01 * m1)
        gm1 = TWO * (s01 * m0 + s11 * m1)
        ga0 = fx * inverse * gm0
        ga1 = fy * inverse * gm1
        ga2 = -(u * ga0 + v * ga1)
        g_u -= ga0 * a2
        g_v -= ga1 * a2
        g_z -= (gm0 * m0 + gm1 * m1) * inverse
        g_factors[i, 0, k] = pose[0, 0] * ga0 + pose[1, 0] * ga1 + pose[2, 0] * ga2
        g_factors[i, 1, k] = pose[0, 1] * ga0 + pose[1, 1] * ga1 + pose[2, 1] * ga2
        g_factors[i, 2, k] = pose[0, 2] * ga0 + pose[1, 2] * ga1 + pose[2, 2] * ga2
    # The clamped tangents are constants; the projected centre always moves.
    gx = fx * inverse * g_mean[0] + free_u * g_u * inverse
    gy = fy * inverse * g_mean[1] + free_v * g_v * inverse
    gz = (
        g_z
        + g_depth
        - inverse
        * (
            fx * x * inverse * g_mean[0]
            + fy * y * inverse * g_mean[1]
            + free_u * g_u * x * inverse
            + free_v * g_v * y * inverse
        )
    )
    for k in range(3):
        g_means[i, k] = pose[0, k] * gx + pose[1, k] * gy + pose[2, k] * gz


@parallel_kernel
def project_backward(
    means,
    factors,
    pose,
    lens,
    limits,
    splats,
    counts,
    offsets,
    pair_covers,
    records,
    depth_channel,
    g_means,
    g_factors,
    g_opacities,
    g_features,
    g_screen,
):
    """Sum each Gaussian's pairs (in a fixed order) and carry the gradients to the world.

    Args:
        records: [pairs, >= 6 + C] from ``blend_backward``; offsets [N + 1]; pair_covers [pairs].
        depth_channel: the feature channel that holds the depth of the centre, or -1.
        g_means [N, 3], g_factors [N, 3, 3], g_opacities [N], g_features [N, C]: out, float32; 0 where culled.
        g_screen: out [N, 2], dL/d(projected centre) per pixel, which density control reads.
    """
    channels = g_features.shape[1]
    count = means.shape[0]
    for task in prange((count + CHUNK - 1) // CHUNK):
        sums = np.empty(6 + channels, np.float32)
        g_mean = np.empty(2, np.float32)
        g_conic = np.empty(3, np.float32)
        for i in range(task * CHUNK, min(count, (task + 1) * CHUNK)):
            sums[:] = ZERO
            any_pair = False
            if counts[i] > 0:
                for pair in range(offsets[i], offsets[i + 1]):
                    if pair_covers[pair] != 0:
                        any_pair = True
                        for column in range(6 + channels):
                            sums[column] += records[pair, column]
            if not any_pair:
                g_opacities[i] = ZERO
                g_screen[i, 0] = g_screen[i, 1] = ZERO
                for k in range(3):
                    g_means[i, k] = ZERO
                    for j in range(3):
                        g_factors[i, k, j] = ZERO
                for channel in range(channels):
                    g_features[i, channel] = ZERO
                continue
            splat = splats[i]
            g_opacities[i] = sums[0] / splat[OPACITY]
            g_mean[0] = splat[CONIC_A] * sums[1] + splat[CONIC_B] * sums[2]
            g_mean[1] = splat[CONIC_B] * sums[1] + splat[CONIC_C] * sums[2]
            g_screen[i, 0], g_screen[i, 1] = g_mean[0], g_mean[1]
            g_conic[0] = -HALF * sums[3]
            g_conic[1] = -sums[4]
            g_conic[2] = -HALF * sums[5]
            for channel in range(channels):
                g_features[i, channel] = sums[6 + channel]
            g_depth = sums[6 + depth_channel] if depth_channel >= 0 else ZERO
            project_backward_one(
                i, means, factors, pose, lens, limits, splat, g_mean, g_conic, g_depth, g_means, g_factors
            )
