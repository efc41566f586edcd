"""Rigidity, isometry and rotation losses over sampled neighbourhoods, with gradients. Twins: ``losses.rigidity_loss``,
``losses.isometry_loss``, ``losses.rotation_loss``.

A pair's gradient falls on both of its Gaussians. Tasks are a fixed number, each with its own accumulator, summed in a
fixed order: no atomics, and the same bits whatever the number of threads.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from scas4d_core.kernels.cascade import rotation_entries, rotation_gradient
from scas4d_core.kernels.jit import ZERO, kernel, parallel_kernel

TASKS = 4
UNDER_ROOT = np.float32(1e-20)
"""Added under each root, as in Dynamic3DGaussians: the gradient at zero distance is zero, not NaN."""

# Columns of an accumulator: mean 0–2, turn 3–6.
COLUMNS = 7


@kernel
def pairs_task(means, turns, previous, sample, neighbours, weights, distances, rigid, isometric, turning, own, losses):
    """The sampled Gaussians ``sample`` of one task; gradients are added to ``own`` [M, 7], losses to ``losses`` [3]."""
    count = neighbours.shape[1]
    for n in range(sample.shape[0]):
        i = sample[n]
        w, x, y, z = turns[i, 0], turns[i, 1], turns[i, 2], turns[i, 3]
        r0, r1, r2, r3, r4, r5, r6, r7, r8 = rotation_entries(w, x, y, z)
        g0 = g1 = g2 = g3 = g4 = g5 = g6 = g7 = g8 = ZERO
        gmx = gmy = gmz = ZERO
        gtw = gtx = gty = gtz = ZERO
        for k in range(count):
            weight = weights[i, k]
            if weight == ZERO:
                continue
            j = neighbours[i, k]
            ox, oy, oz = means[j, 0] - means[i, 0], means[j, 1] - means[i, 1], means[j, 2] - means[i, 2]
            # Rigidity: the neighbour's offset, turned back, is what it was.
            ex = r0 * ox + r3 * oy + r6 * oz - (previous[j, 0] - previous[i, 0])
            ey = r1 * ox + r4 * oy + r7 * oz - (previous[j, 1] - previous[i, 1])
            ez = r2 * ox + r5 * oy + r8 * oz - (previous[j, 2] - previous[i, 2])
            length = np.sqrt(weight * (ex * ex + ey * ey + ez * ez) + UNDER_ROOT)
            losses[0] += length
            pull = rigid * weight / length
            ex *= pull
            ey *= pull
            ez *= pull
            gx = r0 * ex + r1 * ey + r2 * ez
            gy = r3 * ex + r4 * ey + r5 * ez
            gz = r6 * ex + r7 * ey + r8 * ez
            g0 += ox * ex
            g1 += ox * ey
            g2 += ox * ez
            g3 += oy * ex
            g4 += oy * ey
            g5 += oy * ez
            g6 += oz * ex
            g7 += oz * ey
            g8 += oz * ez
            # Isometry: its distance is that of frame 0.
            distance = np.sqrt(ox * ox + oy * oy + oz * oz + UNDER_ROOT)
            stretch = distance - distances[i, k]
            length = np.sqrt(weight * stretch * stretch + UNDER_ROOT)
            losses[1] += length
            pull = isometric * weight * stretch / (length * distance)
            gx += pull * ox
            gy += pull * oy
            gz += pull * oz
            # Rotation: it has turned as this one has.
            dw, dx, dy, dz = turns[j, 0] - w, turns[j, 1] - x, turns[j, 2] - y, turns[j, 3] - z
            length = np.sqrt(weight * (dw * dw + dx * dx + dy * dy + dz * dz) + UNDER_ROOT)
            losses[2] += length
            pull = turning * weight / length
            target = own[j]
            target[0] += gx
            target[1] += gy
            target[2] += gz
            target[3] += pull * dw
            target[4] += pull * dx
            target[5] += pull * dy
            target[6] += pull * dz
            gmx -= gx
            gmy -= gy
            gmz -= gz
            gtw -= pull * dw
            gtx -= pull * dx
            gty -= pull * dy
            gtz -= pull * dz
        qw, qx, qy, qz = rotation_gradient(w, x, y, z, g0, g1, g2, g3, g4, g5, g6, g7, g8)
        target = own[i]
        target[0] += gmx
        target[1] += gmy
        target[2] += gmz
        target[3] += gtw + qw
        target[4] += gtx + qx
        target[5] += gty + qy
        target[6] += gtz + qz


@parallel_kernel
def neighbour_terms(means, turns, previous, sample, neighbours, weights, distances, strengths, accumulators, losses):
    """Weighted sum of the three losses over the sampled Gaussians and its gradient.

    Args:
        means [M, 3], turns [M, 4]: now, the turn since frame t−1. previous: [M, 3] means of frame t−1.
        sample: [S] int64 rows whose neighbours are looked at.
        neighbours [M, k] int32, weights [M, k] (0: no neighbour), distances [M, k] metres at frame 0.
        strengths: [3] float32, weights of rigidity, isometry and rotation over the mean's count S k.
        accumulators: out [4, M, 7], gradients of means and turns; their sum over tasks is the gradient.
        losses: out [4, 3], unweighted sums over pairs by task.
    """
    size = (sample.shape[0] + TASKS - 1) // TASKS
    for task in prange(TASKS):
        accumulators[task] = ZERO
        losses[task] = ZERO
        pairs_task(
            means, turns, previous, sample[task * size : (task + 1) * size], neighbours, weights, distances,
            strengths[0], strengths[1], strengths[2], accumulators[task], losses[task],
        )  # fmt: skip


@parallel_kernel
def gather_terms(accumulators, rows, g_means, g_turns):
    """Add the accumulated gradients to ``g_means`` [N, 3] at ``rows`` [M] and write ``g_turns`` [M, 4]."""
    for i in prange(rows.shape[0]):
        row = rows[i]
        for k in range(3):
            g_means[row, k] += (
                accumulators[0, i, k] + accumulators[1, i, k] + (accumulators[2, i, k] + accumulators[3, i, k])
            )
        for k in range(4):
            g_turns[i, k] = (
                accumulators[0, i, 3 + k]
                + accumulators[1, i, 3 + k]
                + (accumulators[2, i, 3 + k] + accumulators[3, i, 3 + k])
            )
