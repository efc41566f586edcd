"""Cascade of cluster maps and its backward pass (paper, single-layer deformation function and nesting).

Each step processes sixteen Gaussians of one cluster, so values per cluster are scalars and values
per Gaussian are vectors (``Lanes``). ``deform`` combines the steps. Each layer transforms a point
x, the factor F of the Gaussian (nine entries, row-major) and its rotation Q. The Jacobian J of the
map is applied directly to F. The reference implementation is ``engines.torch.deformation.cascade``.

Cluster map, with y = x − p, z = c·y + s, f = 2σ(2z), f' = f(2 − f):
centred x' = p + t + f R y, published x' = f (R y + p + t). Both have J = R (f I + f' e cᵀ),
with e = y (centred) or e = y + Rᵀ(p + t) (published). With separate covariance, factors remain unchanged.

Points are updated by adding a displacement: x' = w + (f − 1) u with w = x + t + (R − I) y, and
u = R y (centred) or u = w (published). All terms except x are 0 if the parameters are 0, so the
identity is bit-exact on every processor.
"""

from __future__ import annotations

import numpy as np

from scas4d_core.guards import EMPTY_CLUSTER, EXPONENT, HALF_TURN
from scas4d_core.kernels import lanes
from scas4d_core.kernels.jit import LOG2_E, ONE, TWO, ZERO, inline, kernel

# Number of columns of a cluster table: rotation matrix 0–8, quaternion 9–12, pivot 13–15, translation 16–18, c 19–21,
# s 22, diagonal of R − I 23–25.
TABLE = 26
# Number of columns of the cluster parameters: r 0–2, t 3–5, c 6–8, s 9.
PARAMETERS = 10
# Number of columns of a block's contribution to the gradient of its cluster: rotation matrix 0–8, quaternion 9–12,
# t 13–15, c 16–18, s 19.
RECORD = 2 * lanes.COUNT

LEAST = np.float32(HALF_TURN)
FEWEST = int(EMPTY_CLUSTER)
LARGEST = np.float32(EXPONENT) / LOG2_E

COUNTED_GUARDS = ("exponent", "half_turn", "folded")
"""Names of the guards that ``apply_cluster_map`` counts."""


@inline
def rotation_entries(w, x, y, z):
    """Converts a unit quaternion to the nine entries of its rotation matrix, in row-major order."""
    return (
        ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y),
        TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x),
        TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y),
    )  # fmt: skip


@inline
def rotation_gradient(w, x, y, z, g0, g1, g2, g3, g4, g5, g6, g7, g8):
    """Backpropagates through ``rotation_entries``.

    Converts dL/dmatrix (nine entries, row-major) to dL/dquaternion.
    """
    gw = TWO * (-z * g1 + y * g2 + z * g3 - x * g5 - y * g6 + x * g7)
    gx = TWO * (y * g1 + z * g2 + y * g3 - TWO * x * g4 - w * g5 + z * g6 + w * g7 - TWO * x * g8)
    gy = TWO * (-TWO * y * g0 + x * g1 + w * g2 + x * g3 + z * g5 - w * g6 + z * g7 - TWO * y * g8)
    gz = TWO * (-TWO * z * g0 - w * g1 + x * g2 + w * g3 - TWO * z * g4 + y * g5 + x * g6 + y * g7)
    return gw, gx, gy, gz


@inline
def product(aw, ax, ay, az, bw, bx, by, bz):
    """Returns the Hamilton product a∘b of quaternions, i.e. rotation b followed by rotation a."""
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


@kernel
def cluster_table(parameters, sums, first, last, count, table):
    """Computes the table of a cluster: rotation, pivot, and the parameters needed to transform points.

    Args:
        parameters: [10] parameters of the cluster.
        sums: [blocks, 3] sum of the points in each block, after the coarser layers.
        first: first block of the cluster.
        last: last block of the cluster, plus 1.
        count: number of points in the cluster.
        table: [26] output.
    """
    px = py = pz = np.float64(0.0)
    for block in range(first, last):
        px += sums[block, 0]
        py += sums[block, 1]
        pz += sums[block, 2]
    count = max(count, FEWEST)
    table[13], table[14], table[15] = px / count, py / count, pz / count
    rx, ry, rz = parameters[0], parameters[1], parameters[2]
    w = ONE / np.float32(np.sqrt(ONE + rx * rx + ry * ry + rz * rz))
    x, y, z = rx * w, ry * w, rz * w
    entries = rotation_entries(w, x, y, z)
    for k in range(9):
        table[k] = entries[k]
    table[9], table[10], table[11], table[12] = w, x, y, z
    for k in range(7):
        table[16 + k] = parameters[3 + k]
    table[23], table[24], table[25] = -TWO * (y * y + z * z), -TWO * (x * x + z * z), -TWO * (x * x + y * y)


@inline
def scaling_terms(table, about_origin, x, y, z):
    """Returns f, y, u and −2z for points.

    The vector that f scales is u = R y for the centred map, and u = R y + p + t for the published
    map.
    """
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = (
        table[0], table[1], table[2], table[3], table[4], table[5], table[6], table[7], table[8]
    )  # fmt: skip
    yx, yy, yz = x - table[13], y - table[14], z - table[15]
    exponent = (yx * table[19] + yy * table[20] + yz * table[21] + table[22]) * -TWO
    f = lanes.fill(TWO) / (lanes.exp(exponent) + ONE)
    ux = yx * r0 + yy * r1 + yz * r2 + about_origin * (table[13] + table[16])
    uy = yx * r3 + yy * r4 + yz * r5 + about_origin * (table[14] + table[17])
    uz = yx * r6 + yy * r7 + yz * r8 + about_origin * (table[15] + table[18])
    return f, yx, yy, yz, ux, uy, uz, exponent


@inline
def move_through_layer(table, about_origin, x, y, z):
    """Returns the coordinates of points after a layer."""
    f, yx, yy, yz, ux, uy, uz, _ = scaling_terms(table, about_origin, x, y, z)
    more = f - ONE
    return (
        x + (table[16] + (yx * table[23] + yy * table[1] + yz * table[2]) + more * ux),
        y + (table[17] + (yx * table[3] + yy * table[24] + yz * table[5]) + more * uy),
        z + (table[18] + (yx * table[6] + yy * table[7] + yz * table[25]) + more * uz),
    )


@inline
def polar(table, about_origin, f, yx, yy, yz):
    """Computes the polar rotation of f I + f' e cᵀ in the plane of e and c; the common factor f is omitted.

    Returns:
        Quaternion a (4 values), followed by values for the backward pass: e (3), e·c, c × e (3), cosine, sine (3),
        their norm rho, the scale of the quaternion, and rho + cosine.
    """
    cx, cy, cz = table[19], table[20], table[21]
    mx, my, mz = table[13] + table[16], table[14] + table[17], table[15] + table[18]
    ex = yx + about_origin * (table[0] * mx + table[3] * my + table[6] * mz)
    ey = yy + about_origin * (table[1] * mx + table[4] * my + table[7] * mz)
    ez = yz + about_origin * (table[2] * mx + table[5] * my + table[8] * mz)
    m = TWO - f
    dot = ex * cx + ey * cy + ez * cz
    nx, ny, nz = cy * ez - cz * ey, cz * ex - cx * ez, cx * ey - cy * ex
    cosine = m * dot + TWO
    sx, sy, sz = m * nx, m * ny, m * nz
    square = sx * sx + sy * sy + sz * sz
    rho = lanes.square_root(cosine * cosine + square)
    half = rho + cosine
    h = lanes.maximum(lanes.fill(LEAST), half)
    scale = lanes.fill(ONE) / lanes.square_root(h * h + square)
    return (
        h * scale, sx * scale, sy * scale, sz * scale, ex, ey, ez, dot, nx, ny, nz, cosine, sx, sy, sz, rho, scale, half
    )  # fmt: skip


@kernel
def apply_cluster_map(table, about_origin, separate, points, place, v, present, lane, guard_counts):
    """Applies a layer to the factors and rotations of a block, in place.

    Args:
        table: [26] table of the block's cluster.
        about_origin: 0 for the centred cluster map, 1 for the published one.
        separate: if None, J is applied to the factors. Otherwise, factors remain unchanged.
        points: points before the layer; x, y and z of the block start at flat index ``place``.
        v: [13, 16] factors (rows 0–8) and rotations (rows 9–12), updated in place.
        present: mask, starting at flat index ``lane``: 0 for Gaussians that are not counted, otherwise 1.
        guard_counts: [3 or more] int64 counts, to which the number of Gaussians that triggered each
            guard in ``COUNTED_GUARDS`` is added. None disables counting.
    """
    x, y, z = (
        lanes.load(points, place), lanes.load(points, place + lanes.COUNT), lanes.load(points, place + 2 * lanes.COUNT)
    )  # fmt: skip
    f, yx, yy, yz, ux, uy, uz, exponent = scaling_terms(table, about_origin, x, y, z)
    slope = f * (TWO - f)
    if separate is None:  # resolved at compile time
        for column in range(3):
            j0, j1, j2 = (
                lanes.load(v, lanes.COUNT * column),
                lanes.load(v, lanes.COUNT * (3 + column)),
                lanes.load(v, lanes.COUNT * (6 + column)),
            )
            along = slope * (j0 * table[19] + j1 * table[20] + j2 * table[21])
            lanes.store(v, lanes.COUNT * column, f * (j0 * table[0] + j1 * table[1] + j2 * table[2]) + ux * along)
            lanes.store(v, lanes.COUNT * (3 + column), f * (j0 * table[3] + j1 * table[4] + j2 * table[5]) + uy * along)
            lanes.store(v, lanes.COUNT * (6 + column), f * (j0 * table[6] + j1 * table[7] + j2 * table[8]) + uz * along)
    a = polar(table, about_origin, f, yx, yy, yz)
    qw, qx, qy, qz = product(table[9], table[10], table[11], table[12], a[0], a[1], a[2], a[3])
    ow, ox, oy, oz = product(
        qw, qx, qy, qz, lanes.load(v, 9 * lanes.COUNT), lanes.load(v, 10 * lanes.COUNT),
        lanes.load(v, 11 * lanes.COUNT), lanes.load(v, 12 * lanes.COUNT),
    )  # fmt: skip
    lanes.store(v, 9 * lanes.COUNT, ow)
    lanes.store(v, 10 * lanes.COUNT, ox)
    lanes.store(v, 11 * lanes.COUNT, oy)
    lanes.store(v, 12 * lanes.COUNT, oz)
    if guard_counts is not None:  # resolved at compile time
        clamped = lanes.magnitude(exponent) > LARGEST
        # det J = f³ (1 + (2 − f) e·c), and the cosine is the second factor plus 1. The map folds
        # space if the determinant is not positive. Half turns are folds too.
        folded = a[11] <= ONE
        if lanes.any_of(clamped):
            guard_counts[0] += lanes.count_of(clamped & (lanes.load(present, lane) > ZERO))
        if lanes.any_of(folded):
            counts = lanes.load(present, lane) > ZERO
            guard_counts[1] += lanes.count_of((a[17] < LEAST) & counts)
            guard_counts[2] += lanes.count_of(folded & counts)


@kernel
def apply_cluster_map_backward(table, about_origin, separate, points, place, v, entering, g, records, record):
    """Backpropagates through a layer for one block.

    Args:
        table, about_origin, separate, points, place: see ``apply_cluster_map``.
        v: factors and rotations before the layer, starting at flat index ``entering``.
        g: [16, 16] gradients of points (rows 0–2), factors (rows 3–11) and rotations (rows 12–15).
            Gradients of the output of the layer are replaced by gradients of its input.
        records: output, starting at flat index ``record``: the contribution of the block to the
            gradient of its cluster.
    """
    n = lanes.COUNT
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = (
        table[0], table[1], table[2], table[3], table[4], table[5], table[6], table[7], table[8]
    )  # fmt: skip
    cx, cy, cz = table[19], table[20], table[21]
    x, y, z = lanes.load(points, place), lanes.load(points, place + n), lanes.load(points, place + 2 * n)
    f, yx, yy, yz, ux, uy, uz, _ = scaling_terms(table, about_origin, x, y, z)
    slope = f * (TWO - f)
    gx, gy, gz = lanes.load(g, 0), lanes.load(g, n), lanes.load(g, 2 * n)
    g_f = gx * ux + gy * uy + gz * uz
    nothing = lanes.fill(ZERO)
    g_slope = nothing
    gux, guy, guz = f * gx, f * gy, f * gz
    gcx = gcy = gcz = nothing
    gr0 = gr1 = gr2 = gr3 = gr4 = gr5 = gr6 = gr7 = gr8 = nothing
    if separate is None:
        for column in range(3):
            j0 = lanes.load(v, entering + n * column)
            j1 = lanes.load(v, entering + n * (3 + column))
            j2 = lanes.load(v, entering + n * (6 + column))
            g0 = lanes.load(g, n * (3 + column))
            g1 = lanes.load(g, n * (6 + column))
            g2 = lanes.load(g, n * (9 + column))
            along = j0 * cx + j1 * cy + j2 * cz
            # Gradients of f and of the columns of the factor, rotated by the inverse of R.
            h0, h1, h2 = g0 * r0 + g1 * r3 + g2 * r6, g0 * r1 + g1 * r4 + g2 * r7, g0 * r2 + g1 * r5 + g2 * r8
            g_f += h0 * j0 + h1 * j1 + h2 * j2
            outer = ux * g0 + uy * g1 + uz * g2
            g_slope += outer * along
            pull = slope * along
            gux += pull * g0
            guy += pull * g1
            guz += pull * g2
            g_along = slope * outer
            gcx += g_along * j0
            gcy += g_along * j1
            gcz += g_along * j2
            k0, k1, k2 = f * g0, f * g1, f * g2
            gr0 += k0 * j0
            gr1 += k0 * j1
            gr2 += k0 * j2
            gr3 += k1 * j0
            gr4 += k1 * j1
            gr5 += k1 * j2
            gr6 += k2 * j0
            gr7 += k2 * j1
            gr8 += k2 * j2
            lanes.store(g, n * (3 + column), f * h0 + g_along * cx)
            lanes.store(g, n * (6 + column), f * h1 + g_along * cy)
            lanes.store(g, n * (9 + column), f * h2 + g_along * cz)
    # Rotations: Q' = (q(r) ∘ polar) ∘ Q.
    aw, ax, ay, az, ex, ey, ez, dot, nx, ny, nz, cosine, sx, sy, sz, rho, scale, half = polar(
        table, about_origin, f, yx, yy, yz
    )
    kw, kx, ky, kz = table[9], table[10], table[11], table[12]
    tw, tx, ty, tz = lanes.load(g, 12 * n), lanes.load(g, 13 * n), lanes.load(g, 14 * n), lanes.load(g, 15 * n)
    lw, lx, ly, lz = product(kw, kx, ky, kz, aw, ax, ay, az)
    hw, hx, hy, hz = product(
        tw, tx, ty, tz, lanes.load(v, entering + 9 * n), -lanes.load(v, entering + 10 * n),
        -lanes.load(v, entering + 11 * n), -lanes.load(v, entering + 12 * n),
    )  # fmt: skip
    ow, ox, oy, oz = product(lw, -lx, -ly, -lz, tw, tx, ty, tz)
    lanes.store(g, 12 * n, ow)
    lanes.store(g, 13 * n, ox)
    lanes.store(g, 14 * n, oy)
    lanes.store(g, 15 * n, oz)
    qw, qx, qy, qz = product(hw, hx, hy, hz, aw, -ax, -ay, -az)
    bw, bx, by, bz = product(kw, -kx, -ky, -kz, hw, hx, hy, hz)
    unit = aw * bw + ax * bx + ay * by + az * bz
    g_h = (bw - aw * unit) * scale
    gsx, gsy, gsz = (bx - ax * unit) * scale, (by - ay * unit) * scale, (bz - az * unit) * scale
    # Clamped values are treated as constants.
    g_h = lanes.choose(half < LEAST, nothing, g_h)
    shrink = g_h / lanes.maximum(lanes.fill(LEAST), rho)
    g_cosine = g_h + cosine * shrink
    gsx += sx * shrink
    gsy += sy * shrink
    gsz += sz * shrink
    g_f -= g_cosine * dot + gsx * nx + gsy * ny + gsz * nz
    m = TWO - f
    g_dot = m * g_cosine
    knx, kny, knz = m * gsx, m * gsy, m * gsz
    gex = g_dot * cx + kny * cz - knz * cy
    gey = g_dot * cy + knz * cx - knx * cz
    gez = g_dot * cz + knx * cy - kny * cx
    # Gradients of f and y.
    g_z = (g_f + g_slope * (TWO - TWO * f)) * slope
    gcx += g_dot * ex + ey * knz - ez * kny + g_z * yx
    gcy += g_dot * ey + ez * knx - ex * knz + g_z * yy
    gcz += g_dot * ez + ex * kny - ey * knx + g_z * yz
    lanes.store(g, 0, gux * r0 + guy * r3 + guz * r6 + gex + g_z * cx)
    lanes.store(g, n, gux * r1 + guy * r4 + guz * r7 + gey + g_z * cy)
    lanes.store(g, 2 * n, gux * r2 + guy * r5 + guz * r8 + gez + g_z * cz)
    mx = about_origin * (table[13] + table[16])
    my = about_origin * (table[14] + table[17])
    mz = about_origin * (table[15] + table[18])
    centred = ONE - about_origin
    sums = lanes.sums_of((
        gr0 + gux * yx + mx * gex, gr1 + gux * yy + mx * gey, gr2 + gux * yz + mx * gez,
        gr3 + guy * yx + my * gex, gr4 + guy * yy + my * gey, gr5 + guy * yz + my * gez,
        gr6 + guz * yx + mz * gex, gr7 + guz * yy + mz * gey, gr8 + guz * yz + mz * gez,
        qw, qx, qy, qz,
        centred * gx + about_origin * (gux + r0 * gex + r1 * gey + r2 * gez),
        centred * gy + about_origin * (guy + r3 * gex + r4 * gey + r5 * gez),
        centred * gz + about_origin * (guz + r6 * gex + r7 * gey + r8 * gez),
    ))  # fmt: skip
    lanes.store(records, record, sums)
    lanes.store(records, record + n, lanes.sums_of((gcx, gcy, gcz, g_z)))


@kernel
def cluster_gradient(records, layer, first, last, table, gradient):
    """Computes dL/dparameters of a cluster by summing the records of its blocks in order.

    Args:
        records: [blocks, layers, 32] contributions of all blocks, from ``apply_cluster_map_backward``.
        layer: layer of the cluster.
        first: first block of the cluster.
        last: last block of the cluster, plus 1.
        table: [26] table of the cluster.
        gradient: [10] output.
    """
    sums = np.empty(RECORD, np.float32)
    low = high = lanes.fill(ZERO)
    for block in range(first, last):
        record = (block * records.shape[1] + layer) * RECORD
        low += lanes.load(records, record)
        high += lanes.load(records, record + lanes.COUNT)
    lanes.store(sums, 0, low)
    lanes.store(sums, lanes.COUNT, high)
    w, x, y, z = table[9], table[10], table[11], table[12]
    gw, gx, gy, gz = rotation_gradient(
        w, x, y, z, sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6], sums[7], sums[8]
    )
    gw, gx, gy, gz = gw + sums[9], gx + sums[10], gy + sums[11], gz + sums[12]
    # Gradient of r, where the quaternion is (1, r) w.
    along = w * gw + x * gx + y * gy + z * gz
    gradient[0], gradient[1], gradient[2] = (gx - x * along) * w, (gy - y * along) * w, (gz - z * along) * w
    for k in range(7):
        gradient[3 + k] = sums[13 + k]
