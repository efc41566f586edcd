"""Kernels that match small patches of a rendering with an image, and that fit rigid motions of clusters to the matches.

A patch is matched with the inverse compositional algorithm of Lucas and Kanade (Baker and Matthews, "Lucas-Kanade 20
Years On", IJCV 2004), from the coarsest level of a pyramid to the finest. The matches of a point in all cameras are
collected in the 3×3 normal equations of its displacement: A d = b, with d in metres and errors in pixels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from scas4d_core.kernels.jit import inline, kernel, parallel_kernel

HALF_PATCH = 4
"""Half of the patch's side, in pixels of each level."""
SIDE = 2 * HALF_PATCH
STEPS = 6
"""Maximum number of iterations per level."""
CONVERGED = 0.02
"""Step, in pixels, below which the iterations of a level end."""
NOISE = 0.0003
"""Squared image gradient, [0, 1] per pixel, that noise explains. Directions with smaller gradients count little."""
MISFIT = 0.05
"""RMS difference between a matched patch and the image at which the match counts half."""
LEVELS = 3
"""Number of levels of a pyramid, each half as large as the one before."""
OUTLIER_PX = 1.0
"""Distance, in pixels, at which a match counts half in the motion of its cluster."""
ROUNDS = 3
"""Number of times that the motion of a cluster is fitted, with the weights of the round before."""
BEHIND = 0.1
"""Weight of pixels of a patch that are on another surface."""


@inline
def _sample(plane: Any, start: Any, width: Any, height: Any, x: Any, y: Any) -> Any:
    """Returns the bilinear value of a level at (x, y), where (0, 0) is the centre of the first pixel."""
    x = min(max(x, 0.0), width - 1.001)
    y = min(max(y, 0.0), height - 1.001)
    column, row = int(x), int(y)
    a, b = x - column, y - row
    first = start + row * width + column
    above = plane[first] * (1 - a) + plane[first + 1] * a
    below = plane[first + width] * (1 - a) + plane[first + width + 1] * a
    return above * (1 - b) + below * b


@parallel_kernel
def match_patches(
    source: NDArray[Any],
    target: NDArray[Any],
    depth: NDArray[Any],
    starts: NDArray[Any],
    sizes: NDArray[Any],
    pose: NDArray[Any],
    lens: NDArray[Any],
    tolerance: float,
    points: NDArray[Any],
    normal: NDArray[Any],
    right: NDArray[Any],
    weight: NDArray[Any],
) -> None:
    """Adds the matches of one camera to the normal equations of N points.

    Args:
        source, target: [P] float32 pyramids of the rendering and the image, levels one after the other, rows by row.
        depth: [H·W] float32 depth of the rendering at the finest level in metres, infinite where nothing is rendered.
        starts: [LEVELS] int64 index of each level's first pixel.
        sizes: [LEVELS, 2] int64 width and height of each level.
        pose: [3, 4] world-to-camera transform.
        lens: [4] fx, fy, cx, cy in pixels of the finest level; pixel centres are at +0.5.
        tolerance: difference in depth, in metres, up to which a point is visible and pixels are on its surface.
        points: [N, 3] float64 positions in the rendered state.
        normal, right: [N, 3, 3] and [N, 3] float64 normal equations A, b, which the function adds to.
        weight: [N] float64 number of matches, which the function adds to. A match of a textured patch counts 1.
    """
    width, height = sizes[0, 0], sizes[0, 1]
    for index in prange(len(points)):
        x, y, z = points[index, 0], points[index, 1], points[index, 2]
        cx = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]
        cy = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]
        cz = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        if not cz > 0:
            continue
        u, v = lens[0] * cx / cz + lens[2], lens[1] * cy / cz + lens[3]
        if not (u >= 1 and v >= 1 and u < width - 1 and v < height - 1):
            continue
        if not cz <= depth[int(v) * width + int(u)] + tolerance:
            continue
        patch, found, w = np.empty((SIDE, SIDE)), np.empty((SIDE, SIDE)), np.empty((SIDE, SIDE))
        gx, gy = np.empty((SIDE, SIDE)), np.empty((SIDE, SIDE))
        dx = dy = hxx = hxy = hyy = total = misfit = 0.0
        for level in range(LEVELS - 1, -1, -1):
            scale = 0.5**level
            start, columns, rows = starts[level], sizes[level, 0], sizes[level, 1]
            px, py = u * scale - 0.5, v * scale - 0.5
            hxx = hxy = hyy = total = mean = 0.0
            for i in range(SIDE):
                for j in range(SIDE):
                    sx, sy = px + j - HALF_PATCH + 0.5, py + i - HALF_PATCH + 0.5
                    fx = min(max(int((sx + 0.5) / scale), 0), width - 1)
                    fy = min(max(int((sy + 0.5) / scale), 0), height - 1)
                    near = abs(depth[fy * width + fx] - cz) <= tolerance
                    w[i, j] = 1.0 if near else BEHIND
                    patch[i, j] = _sample(source, start, columns, rows, sx, sy)
                    gx[i, j] = 0.5 * (
                        _sample(source, start, columns, rows, sx + 1, sy)
                        - _sample(source, start, columns, rows, sx - 1, sy)
                    )
                    gy[i, j] = 0.5 * (
                        _sample(source, start, columns, rows, sx, sy + 1)
                        - _sample(source, start, columns, rows, sx, sy - 1)
                    )
                    hxx += w[i, j] * gx[i, j] * gx[i, j]
                    hxy += w[i, j] * gx[i, j] * gy[i, j]
                    hyy += w[i, j] * gy[i, j] * gy[i, j]
                    total += w[i, j]
                    mean += w[i, j] * patch[i, j]
            mean /= total
            nxx, nyy = hxx + NOISE * total, hyy + NOISE * total
            determinant = nxx * nyy - hxy * hxy
            dx, dy = 2 * dx, 2 * dy
            ox, oy = dx, dy
            for _ in range(STEPS):
                offset = 0.0
                for i in range(SIDE):
                    for j in range(SIDE):
                        sx, sy = px + j - HALF_PATCH + 0.5 + dx, py + i - HALF_PATCH + 0.5 + dy
                        found[i, j] = _sample(target, start, columns, rows, sx, sy)
                        offset += w[i, j] * found[i, j]
                offset = offset / total - mean  # brightness may differ
                bx = by = misfit = 0.0
                for i in range(SIDE):
                    for j in range(SIDE):
                        error = found[i, j] - offset - patch[i, j]
                        bx += w[i, j] * gx[i, j] * error
                        by += w[i, j] * gy[i, j] * error
                        misfit += w[i, j] * error * error
                stepx = -(nyy * bx - hxy * by) / determinant
                stepy = -(nxx * by - hxy * bx) / determinant
                dx, dy = dx + stepx, dy + stepy
                if stepx * stepx + stepy * stepy < CONVERGED * CONVERGED:
                    break
            if (dx - ox) * (dx - ox) + (dy - oy) * (dy - oy) > SIDE * SIDE:
                dx, dy = ox, oy
        # The information matrix S = (H + noise)⁻¹ H is 1 in directions with strong gradients, and 0 in others.
        confidence = 1 / (1 + misfit / total / (MISFIT * MISFIT))
        nxx, nyy = hxx + NOISE * total, hyy + NOISE * total
        determinant = nxx * nyy - hxy * hxy
        sxx = confidence * (nyy * hxx - hxy * hxy) / determinant
        sxy = confidence * (nyy * hxy - hxy * hyy) / determinant
        syy = confidence * (nxx * hyy - hxy * hxy) / determinant
        weight[index] += 0.5 * (sxx + syy)
        for a in range(3):
            ja = lens[0] * (pose[0, a] * cz - pose[2, a] * cx) / (cz * cz)
            ka = lens[1] * (pose[1, a] * cz - pose[2, a] * cy) / (cz * cz)
            right[index, a] += ja * (sxx * dx + sxy * dy) + ka * (sxy * dx + syy * dy)
            for b in range(3):
                jb = lens[0] * (pose[0, b] * cz - pose[2, b] * cx) / (cz * cz)
                kb = lens[1] * (pose[1, b] * cz - pose[2, b] * cy) / (cz * cz)
                normal[index, a, b] += ja * (sxx * jb + sxy * kb) + ka * (sxy * jb + syy * kb)


@kernel
def _solve(matrix: NDArray[Any], right: NDArray[Any]) -> None:
    """Solves a symmetric positive definite system in place (Cholesky); ``right`` becomes the solution.

    The solution of a singular system is not finite.
    """
    size = len(right)
    for i in range(size):
        for j in range(i + 1):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            if i == j:
                matrix[i, i] = np.sqrt(value)
            else:
                matrix[i, j] = value / matrix[j, j]
    for i in range(size):
        for k in range(i):
            right[i] -= matrix[i, k] * right[k]
        right[i] /= matrix[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            right[i] -= matrix[k, i] * right[k]
        right[i] /= matrix[i, i]


@parallel_kernel
def fit_clusters(
    points: NDArray[Any],
    normal: NDArray[Any],
    right: NDArray[Any],
    weight: NDArray[Any],
    starts: NDArray[Any],
    damping: float,
    smallest: float,
    turns: NDArray[Any],
    before: NDArray[Any],
    after: NDArray[Any],
) -> None:
    """Fits the rigid motion of each cluster to the matches of its points.

    Args:
        points: [N, 3] positions of the points in the rendered state.
        normal, right, weight: normal equations and weights of ``match_patches``.
        starts: [K + 1] int64 boundaries of the clusters in the points.
        damping: Levenberg–Marquardt damping of each round, relative to matches of all points in one camera.
        smallest: RMS motion, in pixels, below which a cluster stays where it is.
        turns: [K, 3] resulting rotations, as axis · tan(angle/2).
        before, after: [K, 3] mean of the points before and after the motion.
    """
    for cluster in prange(len(starts) - 1):
        first, last = starts[cluster], starts[cluster + 1]
        count = last - first
        places = points[first:last].copy()
        quaternion = np.array([1.0, 0.0, 0.0, 0.0])
        reliability = np.ones(count)
        system, unknowns = np.empty((6, 6)), np.empty(6)
        basis, moment = np.empty((3, 6)), np.empty(3)
        for axis in range(3):
            total = 0.0
            for row in range(first, last):
                total += points[row, axis]
            before[cluster, axis] = total / max(count, 1)
            after[cluster, axis] = before[cluster, axis]
            turns[cluster, axis] = 0.0
        total = 0.0
        pixels = 0.0
        for row in range(first, last):
            pixels += weight[row]
            total += normal[row, 0, 0] + normal[row, 1, 1] + normal[row, 2, 2]
        if not pixels > 0:
            continue
        per_match = total / pixels  # trace of A for one match
        for _ in range(ROUNDS):
            system[:], unknowns[:] = 0.0, 0.0
            spread = 0.0
            for row in range(first, last):
                rx = places[row - first, 0] - after[cluster, 0]
                ry = places[row - first, 1] - after[cluster, 1]
                rz = places[row - first, 2] - after[cluster, 2]
                spread += rx * rx + ry * ry + rz * rz
                basis[:] = 0.0
                basis[0, 1], basis[0, 2], basis[1, 0] = rz, -ry, -rz
                basis[1, 2], basis[2, 0], basis[2, 1] = rx, ry, -rx
                basis[0, 3] = basis[1, 4] = basis[2, 5] = 1.0
                for a in range(3):
                    moment[a] = right[row, a]
                    for b in range(3):
                        moment[a] -= normal[row, a, b] * (places[row - first, b] - points[row, b])
                gain = reliability[row - first]
                for i in range(6):
                    for a in range(3):
                        unknowns[i] += gain * basis[a, i] * moment[a]
                    for j in range(i + 1):
                        for a in range(3):
                            for b in range(3):
                                system[i, j] += gain * basis[a, i] * normal[row, a, b] * basis[b, j]
            prior = damping * per_match * count / 3
            lever = spread / count / 3
            for i in range(3):
                system[i, i] += prior * lever
                system[3 + i, 3 + i] += prior
            _solve(system, unknowns)
            x, y, z = 0.5 * unknowns[0], 0.5 * unknowns[1], 0.5 * unknowns[2]
            length = np.sqrt(1 + x * x + y * y + z * z)
            w, x, y, z = 1 / length, x / length, y / length, z / length
            a, b, c, d = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
            quaternion[0] = w * a - x * b - y * c - z * d
            quaternion[1] = w * b + x * a + y * d - z * c
            quaternion[2] = w * c - x * d + y * a + z * b
            quaternion[3] = w * d + x * c - y * b + z * a
            for row in range(count):
                rx = places[row, 0] - after[cluster, 0]
                ry = places[row, 1] - after[cluster, 1]
                rz = places[row, 2] - after[cluster, 2]
                tx, ty, tz = 2 * (y * rz - z * ry), 2 * (z * rx - x * rz), 2 * (x * ry - y * rx)
                places[row, 0] = after[cluster, 0] + unknowns[3] + rx + w * tx + y * tz - z * ty
                places[row, 1] = after[cluster, 1] + unknowns[4] + ry + w * ty + z * tx - x * tz
                places[row, 2] = after[cluster, 2] + unknowns[5] + rz + w * tz + x * ty - y * tx
            for axis in range(3):
                after[cluster, axis] += unknowns[3 + axis]
            for row in range(first, last):
                left = 0.0
                for a in range(3):
                    value = right[row, a]
                    for b in range(3):
                        value -= normal[row, a, b] * (places[row - first, b] - points[row, b])
                    left += value * value
                scale = (normal[row, 0, 0] + normal[row, 1, 1] + normal[row, 2, 2]) * weight[row]
                reliability[row - first] = scale / (scale + left / (OUTLIER_PX * OUTLIER_PX)) if scale > 0 else 0.0
        moved = 0.0
        for row in range(first, last):
            for a in range(3):
                for b in range(3):
                    moved += (
                        (places[row - first, a] - points[row, a])
                        * normal[row, a, b]
                        * (places[row - first, b] - points[row, b])
                    )
        if moved > smallest * smallest * pixels and quaternion[0] > 0.1:  # false for a motion that is not finite
            for axis in range(3):
                turns[cluster, axis] = quaternion[1 + axis] / quaternion[0]
        else:
            for axis in range(3):
                after[cluster, axis] = before[cluster, axis]
