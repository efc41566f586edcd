"""Kernels that check and move whole states once per frame. All loops visit the Gaussians row by row."""

from __future__ import annotations

from math import sqrt

import numpy as np

from scas4d_core.kernels.jit import inline, kernel


@inline
def _determinant(factor):
    """Returns the float32 determinant of a 3×3 factor."""
    a, b, c = factor[0], factor[1], factor[2]
    x = np.float32(np.float32(b[1] * c[2]) - np.float32(b[2] * c[1]))
    y = np.float32(np.float32(b[2] * c[0]) - np.float32(b[0] * c[2]))
    z = np.float32(np.float32(b[0] * c[1]) - np.float32(b[1] * c[0]))
    return np.float32(np.float32(a[0] * x + a[1] * y) + a[2] * z)


@kernel
def find_implausible(
    old_means, old_factors, means, factors, rotations, colours, rows, farthest, longest, brightest, bad, squares
):
    """Marks the Gaussians whose new state is not finite, bounded and plausible.

    Args:
        old_means, old_factors: [N, 3] means and [N, 3, 3] factors of the previous state.
        means, factors, rotations, colours: [N, 3], [N, 3, 3], [N, 4] and [N, 3] arrays of the new state.
        rows: [M] rows of the moving Gaussians; the others only have their colours checked.
        farthest: maximum squared displacement, in m².
        longest: maximum squared length of an axis, in m².
        brightest: maximum absolute value of a colour.
        bad: [N] bool output.
        squares: [M, 3] float32 output, squared axis lengths of the moving Gaussians in m².
    """
    for row in range(len(bad)):
        fine = True
        for channel in range(3):
            fine &= abs(colours[row, channel]) <= brightest  # false for NaN
        bad[row] = not fine
    for i in range(len(rows)):
        row = rows[i]
        moved, turned, fine = np.float32(0), np.float32(0), True
        for k in range(3):
            step = means[row, k] - old_means[row, k]
            moved += step * step
            square = np.float32(0)
            for j in range(3):
                square += factors[row, j, k] * factors[row, j, k]
            squares[i, k] = square
            fine &= square <= longest
        for k in range(4):
            turned += rotations[row, k] * rotations[row, k]
        fine &= moved <= farthest and abs(turned - np.float32(1)) < np.float32(0.01)
        fine &= not np.sign(_determinant(old_factors[row])) * np.sign(_determinant(factors[row])) < 0
        bad[row] |= not fine


@kernel
def axes_are_within(squares, rows, lengths, least, most):
    """Returns whether all axes of the moving Gaussians are within their bounds; false if a length is not finite.

    Args:
        squares: [M, 3] squared axis lengths.
        rows: [M] rows of the moving Gaussians.
        lengths: [N, 3] axis lengths to which the bounds are relative.
        least, most: bounds of an axis, relative to its length.
    """
    within = True
    for i in range(len(rows)):
        for k in range(3):
            shortest, longest = least * lengths[rows[i], k], most * lengths[rows[i], k]
            within &= shortest * shortest <= squares[i, k] <= longest * longest
    return within


@kernel
def find_finite(means, factors, rows, finite):
    """Marks the Gaussians whose mean and factor are finite.

    Args:
        means, factors: [N, 3] and [N, 3, 3] arrays of the state.
        rows: [M] rows to check.
        finite: [M] bool output.
    """
    for i in range(len(rows)):
        fine = True
        for k in range(3):
            fine &= np.isfinite(means[rows[i], k])
            for j in range(3):
                fine &= np.isfinite(factors[rows[i], k, j])
        finite[i] = fine


@kernel
def count_votes(gathered, least, share, asked, says):
    """Counts the cameras that see each Gaussian, and those that see it in changed pixels; call it for each camera.

    Args:
        gathered: [N, 2] float32 blended weight of each Gaussian in all pixels of a camera, and in changed ones.
        least: weight above which the camera sees a Gaussian.
        share: share of the weight in changed pixels above which the camera sees the Gaussian change.
        asked, says: [N] int64 numbers of cameras, which are increased.
    """
    for row in range(len(gathered)):
        total = gathered[row, 0]
        sees = total > least
        asked[row] += sees
        says[row] += sees and gathered[row, 1] > share * total


@kernel
def find_outside(means, factors, rows, poses, lenses, widths, outside):
    """Marks the Gaussians that are outside all images, including their extent.

    Args:
        means, factors: [N, 3] and [N, 3, 3] float32 means and covariance factors, in metres.
        rows: [M] rows to check.
        poses: [C, 3, 4] float64 world-to-camera transforms.
        lenses: [C, 6] float64 fx, fy, cx, cy, width, height.
        widths: extent of a Gaussian in standard deviations.
        outside: [N] bool output; only the entries of ``rows`` are written.
    """
    for row in rows:
        longest = np.float32(0)
        for k in range(3):
            square = np.float32(0)
            for j in range(3):
                square += factors[row, j, k] * factors[row, j, k]
            longest = max(longest, square)
        extent = widths * sqrt(longest)
        x, y, z = means[row, 0], means[row, 1], means[row, 2]
        outside[row] = True
        for camera in range(len(poses)):
            pose, lens = poses[camera], lenses[camera]
            depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
            if not depth > 0:
                continue
            u = lens[0] * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) / depth + lens[2]
            v = lens[1] * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) / depth + lens[3]
            border = lens[0] * extent / depth
            if -border < u < lens[4] + border and -border < v < lens[5] + border:
                outside[row] = False
                break


@kernel
def extrapolate_rows(before, after, moving, share, result):
    """Writes states moved further along the motion between two states.

    Args:
        before, after: [N, K] float32 values in the two states.
        moving: [N] bool; the values of all other rows are those of ``after``.
        share: share of the motion to add.
        result: [N, K] float32 output.
    """
    for row in range(len(moving)):
        for k in range(before.shape[1]):
            now = after[row, k]
            result[row, k] = now + share * (now - before[row, k]) if moving[row] else now


@kernel
def rotate_rows(turns, which, vectors, rotated):
    """Rotates vectors by the quaternions (1, r)/|(1, r)|.

    Args:
        turns: [K, 3] float64 r = axis · tan(angle/2).
        which: [M] int32 row of ``turns`` for each vector.
        vectors: [M, 3] float64 vectors.
        rotated: [M, 3] float64 output.
    """
    for i in range(len(which)):
        r, v = turns[which[i]], vectors[i]
        x, y, z = r[1] * v[2] - r[2] * v[1], r[2] * v[0] - r[0] * v[2], r[0] * v[1] - r[1] * v[0]
        scale = 1 + (r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
        rotated[i, 0] = v[0] + 2 * (x + (r[1] * z - r[2] * y)) / scale
        rotated[i, 1] = v[1] + 2 * (y + (r[2] * x - r[0] * z)) / scale
        rotated[i, 2] = v[2] + 2 * (z + (r[0] * y - r[1] * x)) / scale
