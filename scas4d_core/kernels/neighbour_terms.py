"""Rigidity, isometry and rotation losses over sampled neighbourhoods, with gradients.

The reference implementations are ``rigidity_loss``, ``isometry_loss`` and ``rotation_loss`` in
``engines.torch.losses``.

Sixteen sampled Gaussians are processed at a time, each with its k-th neighbour. Every pair
contributes to the gradients of both Gaussians. A fixed number of tasks write to separate
accumulators, which the backward pass of the deformation sums in a fixed order. The kernel thus
needs no atomics, and the result does not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from scas4d_core.guards import ROOT_FLOOR
from scas4d_core.kernels import lanes
from scas4d_core.kernels.cascade import rotation_entries, rotation_gradient
from scas4d_core.kernels.deltas import TIED
from scas4d_core.kernels.jit import ONE, ZERO, kernel, parallel_kernel

TASKS = 4
UNDER_ROOT = np.float32(ROOT_FLOOR)
"""Value added under each square root, so that its derivative stays finite."""


@kernel
def state_of(state, who):
    """Loads the state of sixteen Gaussians, one ``Lanes`` per column."""
    return lanes.transposed(lanes.gather_rows(state, who, 0))


@kernel
def pairs_task(state, sample, neighbours, weights, distances, rigid, isometric, turning, own, losses):
    """Computes the losses [3], summed over the samples of one task, and their gradients.

    The gradients are added to ``own`` [M, 8]. For the other arguments, see ``neighbour_terms``.
    """
    count = neighbours.shape[1]
    who, other = np.empty(lanes.COUNT, np.int64), np.empty(lanes.COUNT, np.int64)
    present = np.empty(lanes.COUNT, np.float32)
    nothing = lanes.fill(ZERO)
    rigidity = isometry = rotation = nothing
    for first in range(0, sample.shape[0], lanes.COUNT):
        for lane in range(lanes.COUNT):
            inside = first + lane < sample.shape[0]
            who[lane] = sample[first + lane if inside else first]
            present[lane] = ONE if inside else ZERO
        here = state_of(state, who)
        mx, my, mz, w, x, y, z, px, py, pz = (
            here[0], here[1], here[2], here[3], here[4], here[5], here[6], here[7], here[8], here[9]
        )  # fmt: skip
        r0, r1, r2, r3, r4, r5, r6, r7, r8 = rotation_entries(w, x, y, z)
        g0 = g1 = g2 = g3 = g4 = g5 = g6 = g7 = g8 = nothing
        gmx = gmy = gmz = gtw = gtx = gty = gtz = nothing
        for k in range(count):
            for lane in range(lanes.COUNT):
                other[lane] = neighbours[who[lane], k]
            there = state_of(state, other)
            weight = lanes.load(present, 0) * lanes.gather_column(weights, who, 0, count, k)
            counts = weight > ZERO
            ox, oy, oz = there[0] - mx, there[1] - my, there[2] - mz
            # Rigidity: the offset of the neighbour, rotated back, should equal its offset in frame
            # t−1.
            ex = r0 * ox + r3 * oy + r6 * oz - (there[7] - px)
            ey = r1 * ox + r4 * oy + r7 * oz - (there[8] - py)
            ez = r2 * ox + r5 * oy + r8 * oz - (there[9] - pz)
            length = lanes.square_root(weight * (ex * ex + ey * ey + ez * ez) + UNDER_ROOT)
            rigidity += lanes.choose(counts, length, nothing)
            pull = rigid * weight / length
            ex, ey, ez = pull * ex, pull * ey, pull * ez
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
            # Isometry: the distance should equal the distance in frame 0.
            distance = lanes.square_root(ox * ox + oy * oy + oz * oz + UNDER_ROOT)
            stretch = distance - lanes.gather_column(distances, who, 0, count, k)
            length = lanes.square_root(weight * stretch * stretch + UNDER_ROOT)
            isometry += lanes.choose(counts, length, nothing)
            pull = isometric * weight * stretch / (length * distance)
            gx += pull * ox
            gy += pull * oy
            gz += pull * oz
            # Rotation: both Gaussians should have the same rotation.
            dw, dx, dy, dz = there[3] - w, there[4] - x, there[5] - y, there[6] - z
            length = lanes.square_root(weight * (dw * dw + dx * dx + dy * dy + dz * dz) + UNDER_ROOT)
            rotation += lanes.choose(counts, length, nothing)
            pull = turning * weight / length
            dw, dx, dy, dz = pull * dw, pull * dx, pull * dy, pull * dz
            lanes.add_halves(
                own, other, 0,
                (gx, gy, gz, dw, dx, dy, dz, nothing),
            )  # fmt: skip
            gmx -= gx
            gmy -= gy
            gmz -= gz
            gtw -= dw
            gtx -= dx
            gty -= dy
            gtz -= dz
        qw, qx, qy, qz = rotation_gradient(w, x, y, z, g0, g1, g2, g3, g4, g5, g6, g7, g8)
        lanes.add_halves(own, who, 0, (gmx, gmy, gmz, gtw + qw, gtx + qx, gty + qy, gtz + qz, nothing))
    losses[0], losses[1], losses[2] = lanes.sum_of(rigidity), lanes.sum_of(isometry), lanes.sum_of(rotation)


@parallel_kernel
def neighbour_terms(state, sample, neighbours, weights, distances, strengths, accumulators, losses):
    """Computes the three losses of Dynamic 3D Gaussians, and the gradient of their weighted sum.

    Args:
        state: [M, 16] state of the moving Gaussians; see ``deltas`` for the columns.
        sample: [S] int64 rows of the sampled Gaussians.
        neighbours: [M, k] int32 rows of the neighbours of each Gaussian.
        weights: [M, k] weights of the pairs, or 0 if there is no neighbour.
        distances: [M, k] distances of the pairs in frame 0, in metres.
        strengths: [3] float32 weights of rigidity, isometry and rotation, divided by the number of pairs S k.
        accumulators: [4, M, 8] output. The gradients are their sum; see ``sum_accumulators``, and ``deltas`` for the
            columns.
        losses: [4, 3] output, unweighted sums of the losses over the pairs of each task.
    """
    size = (sample.shape[0] + TASKS - 1) // TASKS
    for task in prange(TASKS):
        accumulators[task] = ZERO
        pairs_task(
            state, sample[task * size : (task + 1) * size], neighbours, weights, distances,
            strengths[0], strengths[1], strengths[2], accumulators[task], losses[task],
        )  # fmt: skip


@kernel
def sum_accumulators(accumulators, first, last, sums):
    """Sums the four accumulators for the Gaussians in the range [first, last), and writes ``sums`` [M, 8]."""
    numbers, end = accumulators.shape[1] * TIED, last * TIED
    for k in range(first * TIED, end, lanes.COUNT):
        one = lanes.load_first(accumulators, k, end - k) + lanes.load_first(accumulators, numbers + k, end - k)
        two = lanes.load_first(accumulators, 2 * numbers + k, end - k) + lanes.load_first(
            accumulators, 3 * numbers + k, end - k
        )
        lanes.store_first(sums, k, end - k, one + two)
