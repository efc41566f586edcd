"""What each Gaussian does on its own after the cascade (Δp, ΔR, Δs), and the scale loss. Twin: ``deformation.deform``.

F_t = R(Δr) J F_{t−1} diag(exp Δs); x_t = x + Δp; turn = q(Δr) ∘ Q, taken with w ≥ 0.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from scas4d_core.kernels.cascade import BLOCKS, LANES, product, rotation_entries, rotation_gradient
from scas4d_core.kernels.jit import ONE, ZERO, exp, kernel, parallel_kernel

# Rows of a block: 0–2 x, 3–11 J, 12–15 Q, 16–24 Δp Δr Δs, 25–33 F_{t−1}; forward out: 34–36 mean, 37–45 F, 46–49 turn.
LOADED = 34


@kernel
def load_block(first, count, points, jacobians, rotations, deltas, rows, factors, v):
    """Load 16 Gaussians; lanes past the end repeat the last."""
    for lane in range(LANES):
        i = min(first + lane, count - 1)
        for k in range(3):
            v[k, lane] = points[i, k]
        for k in range(9):
            v[3 + k, lane] = jacobians[i, k]
        for k in range(4):
            v[12 + k, lane] = rotations[i, k]
        for k in range(9):
            v[16 + k, lane] = deltas[i, k]
        row = rows[i]
        for k in range(9):
            v[25 + k, lane] = factors[row, k // 3, k % 3]


@kernel
def apply_task(task, points, jacobians, rotations, deltas, rows, factors, means_out, factors_out, turns):
    """A task of ``apply_deltas``."""
    count = points.shape[0]
    v = np.empty((LOADED + 16, LANES), np.float32)
    for first in range(task * BLOCKS * LANES, min(count, (task + 1) * BLOCKS * LANES), LANES):
        load_block(first, count, points, jacobians, rotations, deltas, rows, factors, v)
        for k in range(LANES):
            a, b, c = v[19, k], v[20, k], v[21, k]
            w = ONE / np.sqrt(ONE + a * a + b * b + c * c)
            x, y, z = a * w, b * w, c * w
            r0, r1, r2, r3, r4, r5, r6, r7, r8 = rotation_entries(w, x, y, z)
            for column in range(3):
                f0, f1, f2 = v[25 + column, k], v[28 + column, k], v[31 + column, k]
                stretch = exp(v[22 + column, k])
                e0 = stretch * (v[3, k] * f0 + v[4, k] * f1 + v[5, k] * f2)
                e1 = stretch * (v[6, k] * f0 + v[7, k] * f1 + v[8, k] * f2)
                e2 = stretch * (v[9, k] * f0 + v[10, k] * f1 + v[11, k] * f2)
                v[37 + column, k] = r0 * e0 + r1 * e1 + r2 * e2
                v[40 + column, k] = r3 * e0 + r4 * e1 + r5 * e2
                v[43 + column, k] = r6 * e0 + r7 * e1 + r8 * e2
            qw, qx, qy, qz = product(w, x, y, z, v[12, k], v[13, k], v[14, k], v[15, k])
            sign = ONE if qw >= ZERO else -ONE
            v[46, k] = sign * qw
            v[47, k] = sign * qx
            v[48, k] = sign * qy
            v[49, k] = sign * qz
            v[34, k] = v[0, k] + v[16, k]
            v[35, k] = v[1, k] + v[17, k]
            v[36, k] = v[2, k] + v[18, k]
        for lane in range(min(LANES, count - first)):
            i = first + lane
            row = rows[i]
            for k in range(3):
                means_out[row, k] = v[34 + k, lane]
            for k in range(9):
                factors_out[row, k // 3, k % 3] = v[37 + k, lane]
            for k in range(4):
                turns[i, k] = v[46 + k, lane]


@parallel_kernel
def apply_deltas(points, jacobians, rotations, deltas, rows, factors, means_out, factors_out, turns):
    """The moved Gaussians.

    Args:
        points [M, 3], jacobians [M, 9], rotations [M, 4]: from the cascade. deltas: [M, 9] Δp, Δr, Δs.
        rows: [M] int64, the row of each among all N Gaussians. factors: [N, 3, 3] of frame t−1.
        means_out [N, 3], factors_out [N, 3, 3]: out at ``rows``. turns: out [M, 4], rotation since frame t−1.
    """
    for task in prange((points.shape[0] + LANES * BLOCKS - 1) // (LANES * BLOCKS)):
        apply_task(task, points, jacobians, rotations, deltas, rows, factors, means_out, factors_out, turns)


@kernel
def apply_backward_task(
    task, points, jacobians, rotations, deltas, rows, factors, scale_weight, bounds, g_means, g_factors, g_turns,
    g_points, g_jacobians, g_rotations, g_deltas, losses,
):  # fmt: skip
    """A task of ``apply_deltas_backward``."""
    count = points.shape[0]
    # Rows 34–36 g mean, 37–45 g F, 46–49 g turn, 50–52 bounds; out: 53–61 g J, 62–65 g Q, 66–71 g Δr, g Δs; 72 loss.
    v = np.empty((73, LANES), np.float32)
    for first in range(task * BLOCKS * LANES, min(count, (task + 1) * BLOCKS * LANES), LANES):
        load_block(first, count, points, jacobians, rotations, deltas, rows, factors, v)
        for lane in range(LANES):
            i = min(first + lane, count - 1)
            row = rows[i]
            for k in range(3):
                v[34 + k, lane] = g_means[row, k]
                v[50 + k, lane] = bounds[i, k]
            for k in range(9):
                v[37 + k, lane] = g_factors[row, k // 3, k % 3]
            for k in range(4):
                v[46 + k, lane] = g_turns[i, k]
        for k in range(LANES):
            a, b, c = v[19, k], v[20, k], v[21, k]
            w = ONE / np.sqrt(ONE + a * a + b * b + c * c)
            x, y, z = a * w, b * w, c * w
            r0, r1, r2, r3, r4, r5, r6, r7, r8 = rotation_entries(w, x, y, z)
            g0 = g1 = g2 = g3 = g4 = g5 = g6 = g7 = g8 = ZERO
            j0 = j1 = j2 = j3 = j4 = j5 = j6 = j7 = j8 = ZERO
            excess = ZERO
            for column in range(3):
                f0, f1, f2 = v[25 + column, k], v[28 + column, k], v[31 + column, k]
                stretch = exp(v[22 + column, k])
                e0 = stretch * (v[3, k] * f0 + v[4, k] * f1 + v[5, k] * f2)
                e1 = stretch * (v[6, k] * f0 + v[7, k] * f1 + v[8, k] * f2)
                e2 = stretch * (v[9, k] * f0 + v[10, k] * f1 + v[11, k] * f2)
                h0, h1, h2 = v[37 + column, k], v[40 + column, k], v[43 + column, k]
                g0 += h0 * e0
                g1 += h0 * e1
                g2 += h0 * e2
                g3 += h1 * e0
                g4 += h1 * e1
                g5 += h1 * e2
                g6 += h2 * e0
                g7 += h2 * e1
                g8 += h2 * e2
                # Scale loss on the length of the axis, which ΔR leaves as it is.
                length = np.sqrt(e0 * e0 + e1 * e1 + e2 * e2)
                over = length - v[50 + column, k]
                pull = scale_weight / max(length, np.float32(1e-20)) if over > ZERO else ZERO
                excess += max(over, ZERO)
                p0 = r0 * h0 + r3 * h1 + r6 * h2 + pull * e0
                p1 = r1 * h0 + r4 * h1 + r7 * h2 + pull * e1
                p2 = r2 * h0 + r5 * h1 + r8 * h2 + pull * e2
                v[69 + column, k] = p0 * e0 + p1 * e1 + p2 * e2
                p0 *= stretch
                p1 *= stretch
                p2 *= stretch
                j0 += p0 * f0
                j1 += p0 * f1
                j2 += p0 * f2
                j3 += p1 * f0
                j4 += p1 * f1
                j5 += p1 * f2
                j6 += p2 * f0
                j7 += p2 * f1
                j8 += p2 * f2
            v[53, k] = j0
            v[54, k] = j1
            v[55, k] = j2
            v[56, k] = j3
            v[57, k] = j4
            v[58, k] = j5
            v[59, k] = j6
            v[60, k] = j7
            v[61, k] = j8
            v[72, k] = excess
            qw, _, _, _ = product(w, x, y, z, v[12, k], v[13, k], v[14, k], v[15, k])
            sign = ONE if qw >= ZERO else -ONE
            tw, tx, ty, tz = sign * v[46, k], sign * v[47, k], sign * v[48, k], sign * v[49, k]
            ow, ox, oy, oz = product(w, -x, -y, -z, tw, tx, ty, tz)
            v[62, k] = ow
            v[63, k] = ox
            v[64, k] = oy
            v[65, k] = oz
            hw, hx, hy, hz = product(tw, tx, ty, tz, v[12, k], -v[13, k], -v[14, k], -v[15, k])
            gw, gx, gy, gz = rotation_gradient(w, x, y, z, g0, g1, g2, g3, g4, g5, g6, g7, g8)
            gw += hw
            gx += hx
            gy += hy
            gz += hz
            along = w * gw + x * gx + y * gy + z * gz
            v[66, k] = (gx - x * along) * w
            v[67, k] = (gy - y * along) * w
            v[68, k] = (gz - z * along) * w
        for lane in range(min(LANES, count - first)):
            i = first + lane
            for k in range(3):
                g_points[i, k] = v[34 + k, lane]
                g_deltas[i, k] = v[34 + k, lane]
            for k in range(9):
                g_jacobians[i, k] = v[53 + k, lane]
            for k in range(4):
                g_rotations[i, k] = v[62 + k, lane]
            for k in range(6):
                g_deltas[i, 3 + k] = v[66 + k, lane]
            losses[i] = v[72, lane]


@parallel_kernel
def apply_deltas_backward(
    points, jacobians, rotations, deltas, rows, factors, scale_weight, bounds, g_means, g_factors, g_turns,
    g_points, g_jacobians, g_rotations, g_deltas, losses,
):  # fmt: skip
    """Backward of ``apply_deltas``, with the gradient of the scale loss added.

    Args:
        scale_weight: weight of the scale loss over its mean's count 3M; 0 leaves it out.
        bounds: [M, 3] metres, the length each axis may have.
        g_means [N, 3], g_factors [N, 3, 3], g_turns [M, 4]: in.
        g_points [M, 3], g_jacobians [M, 9], g_rotations [M, 4], g_deltas [M, 9]: out.
        losses: out [M], metres of excess length of each Gaussian's axes, summed over the three.
    """
    for task in prange((points.shape[0] + LANES * BLOCKS - 1) // (LANES * BLOCKS)):
        apply_backward_task(
            task, points, jacobians, rotations, deltas, rows, factors, scale_weight, bounds, g_means, g_factors,
            g_turns, g_points, g_jacobians, g_rotations, g_deltas, losses,
        )  # fmt: skip
