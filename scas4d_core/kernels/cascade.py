"""The cascade of cluster maps and its backward (paper, single-layer deformation function and nesting).

Twin: ``deformation.cascade``. Points are ordered so that every cluster of every layer is a contiguous range. A layer
carries points x [M, 3], Jacobians J [M, 9] (row-major) and rotations Q [M, 4] to the next; layer 0 starts from the
identity. Kernels work on blocks of 16 points: a scratch array of constant shape holds one quantity a row, so that
LLVM turns each statement into one vector instruction.

Cluster map, y = x − p, z = c·y + s, f = 2σ(2z), f' = f(2 − f):
centred x' = p + t + f R y, published x' = f (R y + p + t); both have J = R (f I + f' e cᵀ)
with e = y, or e = y + Rᵀ(p + t).
"""

from __future__ import annotations

import numpy as np
from numba import prange

from scas4d_core.kernels.jit import ONE, TWO, ZERO, exp, inline, kernel, parallel_kernel

LANES = 16
BLOCKS = 16
"""Blocks a task."""

# Rows of a cluster's table: rotation matrix 0–8, quaternion 9–12, pivot 13–15, translation 16–18, c 19–21, s 22.
TABLE = 23
# Columns of a cluster's parameters: r 0–2, t 3–5, c 6–8, s 9.
PARAMETERS = 10
# Columns of a point's gradient record: rotation matrix 0–8, quaternion 9–12, t 13–15, c 16–18, s 19.
RECORD = 20


@inline
def rotation_entries(w, x, y, z):
    """Unit quaternion to the nine entries of its matrix, row by row."""
    return (
        ONE - TWO * (y * y + z * z), TWO * (x * y - w * z), TWO * (x * z + w * y),
        TWO * (x * y + w * z), ONE - TWO * (x * x + z * z), TWO * (y * z - w * x),
        TWO * (x * z - w * y), TWO * (y * z + w * x), ONE - TWO * (x * x + y * y),
    )  # fmt: skip


@inline
def rotation_gradient(w, x, y, z, g0, g1, g2, g3, g4, g5, g6, g7, g8):
    """dL/dquaternion from dL/dmatrix (nine entries, row by row), for the formula of ``rotation_entries``."""
    gw = TWO * (-z * g1 + y * g2 + z * g3 - x * g5 - y * g6 + x * g7)
    gx = TWO * (y * g1 + z * g2 + y * g3 - TWO * x * g4 - w * g5 + z * g6 + w * g7 - TWO * x * g8)
    gy = TWO * (-TWO * y * g0 + x * g1 + w * g2 + x * g3 + z * g5 - w * g6 + z * g7 - TWO * y * g8)
    gz = TWO * (-TWO * z * g0 - w * g1 + x * g2 + w * g3 - TWO * z * g4 + y * g5 + x * g6 + y * g7)
    return gw, gx, gy, gz


@inline
def product(aw, ax, ay, az, bw, bx, by, bz):
    """Quaternion product a∘b: first b, then a."""
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


@kernel
def unit_gradient(norm, w, x, y, z, gw, gx, gy, gz):
    """dL/dr of the quaternion (1, r)/norm from dL/dquaternion; (w, x, y, z) is the unit quaternion."""
    along = w * gw + x * gx + y * gy + z * gz
    return (gx - x * along) / norm, (gy - y * along) / norm, (gz - z * along) / norm


@parallel_kernel
def cluster_tables(points, starts, parameters, tables):
    """Pivot and rotation of every cluster of a layer.

    Args:
        points: [M, 3] as moved by the layers above. starts: [K + 1] int64, each cluster's range of points.
        parameters: [K, 10]. tables: out [K, 23].
    """
    for j in prange(starts.shape[0] - 1):
        px = py = pz = np.float64(0.0)
        for i in range(starts[j], starts[j + 1]):
            px += points[i, 0]
            py += points[i, 1]
            pz += points[i, 2]
        count = max(starts[j + 1] - starts[j], 1)
        table = tables[j]
        table[13], table[14], table[15] = px / count, py / count, pz / count
        rx, ry, rz = parameters[j, 0], parameters[j, 1], parameters[j, 2]
        w = ONE / np.float32(np.sqrt(ONE + rx * rx + ry * ry + rz * rz))
        x, y, z = rx * w, ry * w, rz * w
        entries = rotation_entries(w, x, y, z)
        for k in range(9):
            table[k] = entries[k]
        table[9], table[10], table[11], table[12] = w, x, y, z
        for k in range(7):
            table[16 + k] = parameters[j, 3 + k]


@kernel
def load_block(first, count, points, jacobians, rotations, labels, tables, v):
    """Rows 0–2 x, 3–11 J, 12–15 Q, 16–38 the table of each point's cluster; lanes past the end repeat the last."""
    for lane in range(LANES):
        i = min(first + lane, count - 1)
        for k in range(3):
            v[k, lane] = points[i, k]
        for k in range(9):
            v[3 + k, lane] = jacobians[i, k]
        for k in range(4):
            v[12 + k, lane] = rotations[i, k]
        table = tables[labels[i]]
        for k in range(TABLE):
            v[16 + k, lane] = table[k]


@kernel
def layer_task(
    task, points, jacobians, rotations, labels, tables, about_origin, points_out, jacobians_out, rotations_out
):
    """A task of ``layer``."""
    count = points.shape[0]
    v = np.empty((16 + TABLE + 16, LANES), np.float32)
    for first in range(task * BLOCKS * LANES, min(count, (task + 1) * BLOCKS * LANES), LANES):
        load_block(first, count, points, jacobians, rotations, labels, tables, v)
        for k in range(LANES):
            r0, r1, r2, r3, r4, r5, r6, r7, r8 = (
                v[16, k], v[17, k], v[18, k], v[19, k], v[20, k], v[21, k], v[22, k], v[23, k], v[24, k]
            )  # fmt: skip
            px, py, pz = v[29, k], v[30, k], v[31, k]
            tx, ty, tz = v[32, k], v[33, k], v[34, k]
            cx, cy, cz = v[35, k], v[36, k], v[37, k]
            yx, yy, yz = v[0, k] - px, v[1, k] - py, v[2, k] - pz
            f = TWO / (ONE + exp(-TWO * (cx * yx + cy * yy + cz * yz + v[38, k])))
            slope = f * (TWO - f)
            # u is what the factor multiplies: R y, or R y + p + t.
            mx, my, mz = about_origin * (px + tx), about_origin * (py + ty), about_origin * (pz + tz)
            ux = r0 * yx + r1 * yy + r2 * yz + mx
            uy = r3 * yx + r4 * yy + r5 * yz + my
            uz = r6 * yx + r7 * yy + r8 * yz + mz
            centred = ONE - about_origin
            v[39, k] = f * ux + centred * (px + tx)
            v[40, k] = f * uy + centred * (py + ty)
            v[41, k] = f * uz + centred * (pz + tz)
            for column in range(3):
                j0, j1, j2 = v[3 + column, k], v[6 + column, k], v[9 + column, k]
                along = slope * (cx * j0 + cy * j1 + cz * j2)
                v[42 + column, k] = f * (r0 * j0 + r1 * j1 + r2 * j2) + ux * along
                v[45 + column, k] = f * (r3 * j0 + r4 * j1 + r5 * j2) + uy * along
                v[48 + column, k] = f * (r6 * j0 + r7 * j1 + r8 * j2) + uz * along
            # Polar rotation of f I + f' e cᵀ in the plane of e and c; the common factor f is left out.
            ex = yx + r0 * mx + r3 * my + r6 * mz
            ey = yy + r1 * mx + r4 * my + r7 * mz
            ez = yz + r2 * mx + r5 * my + r8 * mz
            m = TWO - f
            cosine = TWO + m * (cx * ex + cy * ey + cz * ez)
            sx, sy, sz = m * (cy * ez - cz * ey), m * (cz * ex - cx * ez), m * (cx * ey - cy * ex)
            rho = np.sqrt(cosine * cosine + sx * sx + sy * sy + sz * sz)
            h = max(rho + cosine, np.float32(1e-12))
            scale = ONE / np.sqrt(h * h + sx * sx + sy * sy + sz * sz)
            qw, qx, qy, qz = product(
                v[25, k], v[26, k], v[27, k], v[28, k], h * scale, sx * scale, sy * scale, sz * scale
            )
            ow, ox, oy, oz = product(qw, qx, qy, qz, v[12, k], v[13, k], v[14, k], v[15, k])
            v[51, k] = ow
            v[52, k] = ox
            v[53, k] = oy
            v[54, k] = oz
        for lane in range(min(LANES, count - first)):
            i = first + lane
            for k in range(3):
                points_out[i, k] = v[39 + k, lane]
            for k in range(9):
                jacobians_out[i, k] = v[42 + k, lane]
            for k in range(4):
                rotations_out[i, k] = v[51 + k, lane]


@parallel_kernel
def layer(points, jacobians, rotations, labels, tables, about_origin, points_out, jacobians_out, rotations_out):
    """Move points, Jacobians and rotations by one layer of clusters.

    Args:
        points [M, 3], jacobians [M, 9], rotations [M, 4], labels [M] int32 cluster of each point.
        tables: [K, 23] from ``cluster_tables``. about_origin: 0 for the centred map, 1 for the published one.
        points_out, jacobians_out, rotations_out: out, as moved.
    """
    for task in prange((points.shape[0] + LANES * BLOCKS - 1) // (LANES * BLOCKS)):
        layer_task(
            task, points, jacobians, rotations, labels, tables, about_origin, points_out, jacobians_out, rotations_out
        )


@kernel
def layer_backward_task(
    task, points, jacobians, rotations, labels, tables, about_origin, g_points, g_jacobians, g_rotations, records
):
    """A task of ``layer_backward``."""
    count = points.shape[0]
    # Rows 0–38 as loaded; 39–54 the gradients of x, J, Q, in place; 55–74 the record.
    v = np.empty((75, LANES), np.float32)
    for first in range(task * BLOCKS * LANES, min(count, (task + 1) * BLOCKS * LANES), LANES):
        load_block(first, count, points, jacobians, rotations, labels, tables, v)
        for lane in range(LANES):
            i = min(first + lane, count - 1)
            for k in range(3):
                v[39 + k, lane] = g_points[i, k]
            for k in range(9):
                v[42 + k, lane] = g_jacobians[i, k]
            for k in range(4):
                v[51 + k, lane] = g_rotations[i, k]
        for k in range(LANES):
            r0, r1, r2, r3, r4, r5, r6, r7, r8 = (
                v[16, k], v[17, k], v[18, k], v[19, k], v[20, k], v[21, k], v[22, k], v[23, k], v[24, k]
            )  # fmt: skip
            px, py, pz = v[29, k], v[30, k], v[31, k]
            tx, ty, tz = v[32, k], v[33, k], v[34, k]
            cx, cy, cz = v[35, k], v[36, k], v[37, k]
            yx, yy, yz = v[0, k] - px, v[1, k] - py, v[2, k] - pz
            f = TWO / (ONE + exp(-TWO * (cx * yx + cy * yy + cz * yz + v[38, k])))
            slope = f * (TWO - f)
            mx, my, mz = about_origin * (px + tx), about_origin * (py + ty), about_origin * (pz + tz)
            ux = r0 * yx + r1 * yy + r2 * yz + mx
            uy = r3 * yx + r4 * yy + r5 * yz + my
            uz = r6 * yx + r7 * yy + r8 * yz + mz
            gx, gy, gz = v[39, k], v[40, k], v[41, k]
            g_f = gx * ux + gy * uy + gz * uz
            g_slope = ZERO
            gux, guy, guz = f * gx, f * gy, f * gz
            gcx = gcy = gcz = ZERO
            gr0 = gr1 = gr2 = gr3 = gr4 = gr5 = gr6 = gr7 = gr8 = ZERO
            for column in range(3):
                j0, j1, j2 = v[3 + column, k], v[6 + column, k], v[9 + column, k]
                g0, g1, g2 = v[42 + column, k], v[45 + column, k], v[48 + column, k]
                along = cx * j0 + cy * j1 + cz * j2
                g_f += (
                    g0 * (r0 * j0 + r1 * j1 + r2 * j2)
                    + g1 * (r3 * j0 + r4 * j1 + r5 * j2)
                    + g2 * (r6 * j0 + r7 * j1 + r8 * j2)
                )
                outer = ux * g0 + uy * g1 + uz * g2
                g_slope += outer * along
                gux += slope * along * g0
                guy += slope * along * g1
                guz += slope * along * g2
                g_along = slope * outer
                gcx += g_along * j0
                gcy += g_along * j1
                gcz += g_along * j2
                gr0 += f * g0 * j0
                gr1 += f * g0 * j1
                gr2 += f * g0 * j2
                gr3 += f * g1 * j0
                gr4 += f * g1 * j1
                gr5 += f * g1 * j2
                gr6 += f * g2 * j0
                gr7 += f * g2 * j1
                gr8 += f * g2 * j2
                v[42 + column, k] = f * (r0 * g0 + r3 * g1 + r6 * g2) + g_along * cx
                v[45 + column, k] = f * (r1 * g0 + r4 * g1 + r7 * g2) + g_along * cy
                v[48 + column, k] = f * (r2 * g0 + r5 * g1 + r8 * g2) + g_along * cz
            # The rotations: Q' = (q(r) ∘ polar) ∘ Q.
            ex = yx + r0 * mx + r3 * my + r6 * mz
            ey = yy + r1 * mx + r4 * my + r7 * mz
            ez = yz + r2 * mx + r5 * my + r8 * mz
            m = TWO - f
            dot = cx * ex + cy * ey + cz * ez
            nx, ny, nz = cy * ez - cz * ey, cz * ex - cx * ez, cx * ey - cy * ex
            cosine = TWO + m * dot
            sx, sy, sz = m * nx, m * ny, m * nz
            rho = np.sqrt(cosine * cosine + sx * sx + sy * sy + sz * sz)
            h = max(rho + cosine, np.float32(1e-12))
            scale = ONE / np.sqrt(h * h + sx * sx + sy * sy + sz * sz)
            aw, ax, ay, az = h * scale, sx * scale, sy * scale, sz * scale
            lw, lx, ly, lz = product(v[25, k], v[26, k], v[27, k], v[28, k], aw, ax, ay, az)
            hw, hx, hy, hz = product(v[51, k], v[52, k], v[53, k], v[54, k], v[12, k], -v[13, k], -v[14, k], -v[15, k])
            ow, ox, oy, oz = product(lw, -lx, -ly, -lz, v[51, k], v[52, k], v[53, k], v[54, k])
            v[51, k] = ow
            v[52, k] = ox
            v[53, k] = oy
            v[54, k] = oz
            qw, qx, qy, qz = product(hw, hx, hy, hz, aw, -ax, -ay, -az)
            bw, bx, by, bz = product(v[25, k], -v[26, k], -v[27, k], -v[28, k], hw, hx, hy, hz)
            unit = aw * bw + ax * bx + ay * by + az * bz
            g_h = (bw - aw * unit) * scale
            gsx, gsy, gsz = (bx - ax * unit) * scale, (by - ay * unit) * scale, (bz - az * unit) * scale
            shrink = g_h / max(rho, np.float32(1e-12))
            g_cosine = g_h + cosine * shrink
            gsx += sx * shrink
            gsy += sy * shrink
            gsz += sz * shrink
            g_f -= g_cosine * dot + gsx * nx + gsy * ny + gsz * nz
            g_dot = m * g_cosine
            knx, kny, knz = m * gsx, m * gsy, m * gsz
            gcx += g_dot * ex + ey * knz - ez * kny
            gcy += g_dot * ey + ez * knx - ex * knz
            gcz += g_dot * ez + ex * kny - ey * knx
            gex = g_dot * cx + kny * cz - knz * cy
            gey = g_dot * cy + knz * cx - knx * cz
            gez = g_dot * cz + knx * cy - kny * cx
            # The factor, then y.
            g_z = (g_f + g_slope * (TWO - TWO * f)) * slope
            gcx += g_z * yx
            gcy += g_z * yy
            gcz += g_z * yz
            v[39, k] = r0 * gux + r3 * guy + r6 * guz + gex + g_z * cx
            v[40, k] = r1 * gux + r4 * guy + r7 * guz + gey + g_z * cy
            v[41, k] = r2 * gux + r5 * guy + r8 * guz + gez + g_z * cz
            v[55, k] = gr0 + gux * yx + mx * gex
            v[56, k] = gr1 + gux * yy + mx * gey
            v[57, k] = gr2 + gux * yz + mx * gez
            v[58, k] = gr3 + guy * yx + my * gex
            v[59, k] = gr4 + guy * yy + my * gey
            v[60, k] = gr5 + guy * yz + my * gez
            v[61, k] = gr6 + guz * yx + mz * gex
            v[62, k] = gr7 + guz * yy + mz * gey
            v[63, k] = gr8 + guz * yz + mz * gez
            v[64, k] = qw
            v[65, k] = qx
            v[66, k] = qy
            v[67, k] = qz
            centred = ONE - about_origin
            v[68, k] = centred * gx + about_origin * (gux + r0 * gex + r1 * gey + r2 * gez)
            v[69, k] = centred * gy + about_origin * (guy + r3 * gex + r4 * gey + r5 * gez)
            v[70, k] = centred * gz + about_origin * (guz + r6 * gex + r7 * gey + r8 * gez)
            v[71, k] = gcx
            v[72, k] = gcy
            v[73, k] = gcz
            v[74, k] = g_z
        for lane in range(min(LANES, count - first)):
            i = first + lane
            for k in range(3):
                g_points[i, k] = v[39 + k, lane]
            for k in range(9):
                g_jacobians[i, k] = v[42 + k, lane]
            for k in range(4):
                g_rotations[i, k] = v[51 + k, lane]
            for k in range(RECORD):
                records[i, k] = v[55 + k, lane]


@parallel_kernel
def layer_backward(
    points, jacobians, rotations, labels, tables, about_origin, g_points, g_jacobians, g_rotations, records
):
    """Backward of ``layer``.

    Args:
        points, jacobians, rotations: what went into the layer.
        g_points, g_jacobians, g_rotations: in, gradients of what came out; out, of what went in.
        records: out [M, 20], each point's share of its cluster's gradient.
    """
    for task in prange((points.shape[0] + LANES * BLOCKS - 1) // (LANES * BLOCKS)):
        layer_backward_task(
            task, points, jacobians, rotations, labels, tables, about_origin,
            g_points, g_jacobians, g_rotations, records,
        )  # fmt: skip


@parallel_kernel
def cluster_gradients(records, starts, parameters, tables, gradients):
    """Sum the records of each cluster, in order, into dL/dparameters [K, 10]."""
    for j in prange(starts.shape[0] - 1):
        sums = np.zeros(RECORD, np.float32)
        for i in range(starts[j], starts[j + 1]):
            for k in range(RECORD):
                sums[k] += records[i, k]
        w, x, y, z = tables[j, 9], tables[j, 10], tables[j, 11], tables[j, 12]
        gw, gx, gy, gz = rotation_gradient(
            w, x, y, z, sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6], sums[7], sums[8]
        )
        g0, g1, g2 = unit_gradient(ONE / w, w, x, y, z, gw + sums[9], gx + sums[10], gy + sums[11], gz + sums[12])
        gradients[j, 0], gradients[j, 1], gradients[j, 2] = g0, g1, g2
        for k in range(7):
            gradients[j, 3 + k] = sums[13 + k]
