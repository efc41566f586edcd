"""Rotations of neighbourhoods of Gaussians between two states (Kabsch 1976), and shortest axes of Gaussians.

The rotation of a neighbourhood is u₁v₁ᵀ + u₂v₂ᵀ + (u₁×u₂)(v₁×v₂)ᵀ, where uₖ and vₖ are the two leading singular vectors
of the covariance H of the positions. It is a proper rotation, even if the neighbourhood is flat. v is an eigenvector of
HᵀH, found with Jacobi rotations, and u is Hv, normalized.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numba import prange

from scas4d_core.kernels.jit import inline, kernel, parallel_kernel

CHUNK = 512
SWEEPS = 12
"""Maximum number of Jacobi sweeps; four or five suffice to float64 precision."""
FLAT = 1e-24
"""Ratio of the squares of the second and the first singular value below which a neighbourhood is a line or a point."""


@inline
def _cross(a, b, out):
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@kernel
def _rotate_pair(matrix, vectors, p, q):
    """Applies the Jacobi rotation that makes element (p, q) of a symmetric 3×3 matrix zero."""
    off = matrix[p, q]
    if off == 0:
        return
    half = 0.5 * (matrix[q, q] - matrix[p, p])
    t = off / (abs(half) + sqrt(half * half + off * off))
    if half < 0:
        t = -t
    c = 1 / sqrt(1 + t * t)
    s = t * c
    r = 3 - p - q
    matrix[p, p] -= t * off
    matrix[q, q] += t * off
    matrix[p, q] = matrix[q, p] = 0
    one, two = matrix[p, r], matrix[q, r]
    matrix[p, r] = matrix[r, p] = c * one - s * two
    matrix[q, r] = matrix[r, q] = s * one + c * two
    for k in range(3):
        one, two = vectors[k, p], vectors[k, q]
        vectors[k, p], vectors[k, q] = c * one - s * two, s * one + c * two


@kernel
def _diagonalize(matrix, vectors):
    """Makes a finite symmetric 3×3 matrix diagonal, and writes its eigenvectors to the columns of ``vectors``."""
    size = 0.0
    for i in range(3):
        for j in range(3):
            vectors[i, j] = i == j
            size += matrix[i, j] * matrix[i, j]
    for _ in range(SWEEPS):
        rest = matrix[0, 1] * matrix[0, 1] + matrix[0, 2] * matrix[0, 2] + matrix[1, 2] * matrix[1, 2]
        if rest <= 1e-34 * size:
            break
        _rotate_pair(matrix, vectors, 0, 1)
        _rotate_pair(matrix, vectors, 0, 2)
        _rotate_pair(matrix, vectors, 1, 2)


@kernel
def _smallest(matrix):
    """Returns the index of the smallest diagonal element of a 3×3 matrix."""
    least = 0
    for k in range(1, 3):
        if matrix[k, k] < matrix[least, least]:
            least = k
    return least


@kernel
def _rotation_of(spread, normal, vectors, work, turn):
    """Writes the rotation of a neighbourhood, given the covariance ``spread`` [3, 3] of new and old positions.

    If the covariance is not finite, or does not determine a rotation, the result is the identity.

    Args:
        spread: [3, 3] float64 covariance, new by old.
        normal, vectors, work: [3, 3] scratch.
        turn: [3, 3] float64 output.
    """
    finite = True
    for i in range(3):
        for j in range(3):
            turn[i, j] = i == j
            normal[i, j] = spread[0, i] * spread[0, j] + spread[1, i] * spread[1, j] + spread[2, i] * spread[2, j]
            finite &= np.isfinite(normal[i, j])
    if not finite:
        return
    _diagonalize(normal, vectors)
    least = _smallest(normal)
    first, second = (least + 1) % 3, (least + 2) % 3
    if normal[first, first] < normal[second, second]:
        first, second = second, first
    if normal[second, second] <= FLAT * normal[first, first]:
        return
    u, v = work[:3], work[3:]
    for row in range(3):
        v[0, row], v[1, row] = vectors[row, first], vectors[row, second]
    for row in range(3):
        u[0, row] = spread[row, 0] * v[0, 0] + spread[row, 1] * v[0, 1] + spread[row, 2] * v[0, 2]
        u[1, row] = spread[row, 0] * v[1, 0] + spread[row, 1] * v[1, 1] + spread[row, 2] * v[1, 2]
    length = sqrt(u[0, 0] * u[0, 0] + u[0, 1] * u[0, 1] + u[0, 2] * u[0, 2])
    for k in range(3):
        u[0, k] /= length
    along = u[0, 0] * u[1, 0] + u[0, 1] * u[1, 1] + u[0, 2] * u[1, 2]
    for k in range(3):
        u[1, k] -= along * u[0, k]
    length = sqrt(u[1, 0] * u[1, 0] + u[1, 1] * u[1, 1] + u[1, 2] * u[1, 2])
    for k in range(3):
        u[1, k] /= length
    _cross(u[0], u[1], u[2])
    _cross(v[0], v[1], v[2])
    for i in range(3):
        for j in range(3):
            turn[i, j] = u[0, i] * v[0, j] + u[1, i] * v[1, j] + u[2, i] * v[2, j]


@parallel_kernel
def turn_neighbourhoods(before, after, near, turns):
    """Writes the rotation of each Gaussian's neighbourhood between two states.

    Args:
        before, after: [N, 3] float32 positions in the two states, in metres.
        near: [M, k] int64 rows of the Gaussians in each neighbourhood.
        turns: [M, 3, 3] float64 output.
    """
    count, size = near.shape
    for chunk in prange(-(-count // CHUNK)):
        spread, normal, vectors = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
        work, old, new = np.empty((6, 3)), np.empty((3, size)), np.empty((3, size))
        for i in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
            for k in range(size):
                row = near[i, k]
                for axis in range(3):
                    old[axis, k], new[axis, k] = before[row, axis], after[row, axis]
            for axis in range(3):
                old[axis] -= old[axis].sum() / size
                new[axis] -= new[axis].sum() / size
            for a in range(3):
                for b in range(3):
                    total = 0.0
                    for k in range(size):
                        total += new[a, k] * old[b, k]
                    spread[a, b] = total
            _rotation_of(spread, normal, vectors, work, turns[i])


@kernel
def shortest_axes(factors, axes):
    """Writes the direction of the shortest axis of each Gaussian, with arbitrary sign.

    Args:
        factors: [N, 3, 3] float32 covariance factors.
        axes: [N, 3] float64 output, unit vectors.
    """
    covariance, vectors = np.empty((3, 3)), np.empty((3, 3))
    for row in range(len(factors)):
        factor = factors[row].astype(np.float64)
        for i in range(3):
            for j in range(3):
                covariance[i, j] = (
                    factor[i, 0] * factor[j, 0] + factor[i, 1] * factor[j, 1] + factor[i, 2] * factor[j, 2]
                )
        _diagonalize(covariance, vectors)
        axes[row] = vectors[:, _smallest(covariance)]
