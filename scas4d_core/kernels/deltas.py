"""Per-Gaussian deltas (Δp, ΔR, Δs), which are applied after the cascade, and the scale loss.

    F_t = R(Δr) J F_{t−1} diag(exp Δs),    x_t = x + Δp,    turn = ± q(Δr) ∘ Q

The sign of the turn is chosen such that w ≥ 0. As in ``cascade``, sixteen Gaussians are processed
at a time. The reference implementation is ``engines.torch.deformation.deform``.
"""

from __future__ import annotations

import numpy as np

from scas4d_core.guards import EXPONENT
from scas4d_core.kernels import lanes
from scas4d_core.kernels.cascade import product, rotation_entries, rotation_gradient
from scas4d_core.kernels.jit import LOG2_E, ONE, ZERO, inline, kernel

LARGEST = np.float32(EXPONENT) / LOG2_E

COLUMNS = 9
"""Number of columns of ``deltas``: Δp 0–2, Δr 3–5, Δs 6–8."""

# Columns of the Gaussian state that the neighbour terms use: current mean 0–2, rotation since frame
# t−1 3–6, mean in frame t−1 7–9. Each row is one cache line.
STATE = 16
MEAN, TURN, PREVIOUS = 0, 3, 7
TIED = 8
"""Number of columns of the state gradients: mean 0–2, rotation 3–6, and one unused column."""


@inline
def gaussian_delta_rotation(deltas, entries, place):
    """Returns the rotations ΔR of sixteen Gaussians as unit quaternions (1, Δr)/|(1, Δr)|."""
    a = lanes.gather_column(deltas, entries, place, COLUMNS, 3)
    b = lanes.gather_column(deltas, entries, place, COLUMNS, 4)
    c = lanes.gather_column(deltas, entries, place, COLUMNS, 5)
    w = lanes.fill(ONE) / lanes.square_root(a * a + b * b + c * c + ONE)
    return w, a * w, b * w, c * w


@kernel
def apply_gaussian_deltas(deltas, entries, rows, place, present, v, points, means, factors, state, guard_counts):
    """Computes and stores sixteen deformed Gaussians.

    Args:
        deltas: [M, 9] per-Gaussian deltas.
        entries: int64 indices of the Gaussians among the M moving ones, starting at flat index ``place``.
        rows: int64 indices of the Gaussians among all N, starting at flat index ``place``.
        place: flat index of the first Gaussian in ``entries``, ``rows`` and ``present``.
        present: mask, starting at flat index ``place``; see ``deform.deform``. The guards count
            only Gaussians whose value is 1.
        v: [13, 16] factors (rows 0–8) and rotations (rows 9–12) from the cascade.
        points: [3, 16] points from the cascade.
        means: [N, 3] output, written at ``rows``.
        factors: [N, 3, 3] output, written at ``rows``.
        state: [M, 16] output. Only means and rotations are written.
        guard_counts: [1 or more] int64 counts. The number of Gaussians with a clamped Δs is added
            to the first count.
    """
    n = lanes.COUNT
    for k in range(3):
        mean = lanes.load(points, n * k) + lanes.gather_column(deltas, entries, place, COLUMNS, k)
        lanes.scatter_column(means, rows, place, 3, k, mean)
        lanes.scatter_column(state, entries, place, STATE, MEAN + k, mean)
    w, x, y, z = gaussian_delta_rotation(deltas, entries, place)
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = rotation_entries(w, x, y, z)
    largest = lanes.fill(ZERO)
    for column in range(3):
        exponent = lanes.gather_column(deltas, entries, place, COLUMNS, 6 + column)
        largest = lanes.maximum(largest, lanes.magnitude(exponent))
        stretch = lanes.exp(exponent)
        e0 = stretch * lanes.load(v, n * column)
        e1 = stretch * lanes.load(v, n * (3 + column))
        e2 = stretch * lanes.load(v, n * (6 + column))
        lanes.scatter_column(factors, rows, place, 9, column, r0 * e0 + r1 * e1 + r2 * e2)
        lanes.scatter_column(factors, rows, place, 9, 3 + column, r3 * e0 + r4 * e1 + r5 * e2)
        lanes.scatter_column(factors, rows, place, 9, 6 + column, r6 * e0 + r7 * e1 + r8 * e2)
    if lanes.any_of(largest > LARGEST):
        guard_counts[0] += lanes.count_of((largest > LARGEST) & (lanes.load(present, place) > ZERO))
    qw, qx, qy, qz = product(
        w, x, y, z, lanes.load(v, 9 * n), lanes.load(v, 10 * n), lanes.load(v, 11 * n), lanes.load(v, 12 * n)
    )
    sign = lanes.choose(qw >= ZERO, lanes.fill(ONE), lanes.fill(-ONE))
    lanes.scatter_column(state, entries, place, STATE, TURN + 0, sign * qw)
    lanes.scatter_column(state, entries, place, STATE, TURN + 1, sign * qx)
    lanes.scatter_column(state, entries, place, STATE, TURN + 2, sign * qy)
    lanes.scatter_column(state, entries, place, STATE, TURN + 3, sign * qz)


@kernel
def apply_gaussian_deltas_backward(
    deltas, entries, rows, place, present, v, leaving, scale_weight, bounds, g_means, g_factors, g_tied, g, g_deltas
):
    """Backpropagates through ``apply_gaussian_deltas``, and adds the gradient of the scale loss.

    Args:
        deltas, entries, rows, place: see ``apply_gaussian_deltas``.
        present: mask, starting at flat index ``place``; see ``deform.deform``.
        v: factors and rotations from the cascade, starting at flat index ``leaving``.
        leaving: flat index of the first value in ``v``.
        scale_weight: weight of the scale loss, divided by the number of averaged values, 3M. If the
            weight is 0, the loss has no gradient.
        bounds: [M, 3] axis lengths above which the scale loss applies, in metres.
        g_means: [N, 3] gradients of the means.
        g_factors: [N, 3, 3] gradients of the factors.
        g_tied: [M, 8] additional gradients of means and rotations, from the neighbour terms.
        g: [16, 16] output, gradients of the points (rows 0–2), factors (rows 3–11) and rotations
            (rows 12–15) after the cascade.
        g_deltas: [M, 9] output, gradients of the deltas.

    Returns:
        Total length in metres by which axes exceed their bounds.
    """
    n = lanes.COUNT
    nothing = lanes.fill(ZERO)
    counts = lanes.load(present, place) > ZERO
    for k in range(3):
        pull = lanes.gather_column(g_means, rows, place, 3, k) + lanes.gather_column(g_tied, entries, place, TIED, k)
        lanes.scatter_column(g_deltas, entries, place, COLUMNS, k, pull)
        lanes.store(g, n * k, lanes.choose(counts, pull, nothing))
    w, x, y, z = gaussian_delta_rotation(deltas, entries, place)
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = rotation_entries(w, x, y, z)
    g0 = g1 = g2 = g3 = g4 = g5 = g6 = g7 = g8 = nothing
    excess = nothing
    for column in range(3):
        exponent = lanes.gather_column(deltas, entries, place, COLUMNS, 6 + column)
        stretch = lanes.exp(exponent)
        e0 = stretch * lanes.load(v, leaving + n * column)
        e1 = stretch * lanes.load(v, leaving + n * (3 + column))
        e2 = stretch * lanes.load(v, leaving + n * (6 + column))
        h0 = lanes.gather_column(g_factors, rows, place, 9, column)
        h1 = lanes.gather_column(g_factors, rows, place, 9, 3 + column)
        h2 = lanes.gather_column(g_factors, rows, place, 9, 6 + column)
        g0 += h0 * e0
        g1 += h0 * e1
        g2 += h0 * e2
        g3 += h1 * e0
        g4 += h1 * e1
        g5 += h1 * e2
        g6 += h2 * e0
        g7 += h2 * e1
        g8 += h2 * e2
        # Scale loss of the axis length, which does not depend on ΔR.
        length = lanes.square_root(e0 * e0 + e1 * e1 + e2 * e2)
        bound = lanes.gather_column(bounds, entries, place, 3, column)
        over = length - bound
        pull = lanes.choose(over > ZERO, scale_weight / lanes.maximum(bound, length), nothing)
        excess += lanes.maximum(nothing, over)
        p0 = r0 * h0 + r3 * h1 + r6 * h2 + pull * e0
        p1 = r1 * h0 + r4 * h1 + r7 * h2 + pull * e1
        p2 = r2 * h0 + r5 * h1 + r8 * h2 + pull * e2
        g_exponent = p0 * e0 + p1 * e1 + p2 * e2
        free = lanes.magnitude(exponent) <= LARGEST
        lanes.scatter_column(g_deltas, entries, place, COLUMNS, 6 + column, lanes.choose(free, g_exponent, nothing))
        lanes.store(g, n * (3 + column), lanes.choose(counts, stretch * p0, nothing))
        lanes.store(g, n * (6 + column), lanes.choose(counts, stretch * p1, nothing))
        lanes.store(g, n * (9 + column), lanes.choose(counts, stretch * p2, nothing))
    bw, bx, by, bz = (
        lanes.load(v, leaving + 9 * n), lanes.load(v, leaving + 10 * n),
        lanes.load(v, leaving + 11 * n), lanes.load(v, leaving + 12 * n),
    )  # fmt: skip
    qw, _, _, _ = product(w, x, y, z, bw, bx, by, bz)
    sign = lanes.choose(qw >= ZERO, lanes.fill(ONE), lanes.fill(-ONE))
    tw = sign * lanes.gather_column(g_tied, entries, place, TIED, 3)
    tx = sign * lanes.gather_column(g_tied, entries, place, TIED, 4)
    ty = sign * lanes.gather_column(g_tied, entries, place, TIED, 5)
    tz = sign * lanes.gather_column(g_tied, entries, place, TIED, 6)
    ow, ox, oy, oz = product(w, -x, -y, -z, tw, tx, ty, tz)
    lanes.store(g, 12 * n, lanes.choose(counts, ow, nothing))
    lanes.store(g, 13 * n, lanes.choose(counts, ox, nothing))
    lanes.store(g, 14 * n, lanes.choose(counts, oy, nothing))
    lanes.store(g, 15 * n, lanes.choose(counts, oz, nothing))
    hw, hx, hy, hz = product(tw, tx, ty, tz, bw, -bx, -by, -bz)
    gw, gx, gy, gz = rotation_gradient(w, x, y, z, g0, g1, g2, g3, g4, g5, g6, g7, g8)
    gw += hw
    gx += hx
    gy += hy
    gz += hz
    along = w * gw + x * gx + y * gy + z * gz
    lanes.scatter_column(g_deltas, entries, place, COLUMNS, 3, (gx - x * along) * w)
    lanes.scatter_column(g_deltas, entries, place, COLUMNS, 4, (gy - y * along) * w)
    lanes.scatter_column(g_deltas, entries, place, COLUMNS, 5, (gz - z * along) * w)
    return lanes.sum_of(lanes.choose(counts, excess, nothing))
