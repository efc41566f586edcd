"""Kernel that checks whole states once per frame. Its loops visit the Gaussians row by row."""

from __future__ import annotations

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
