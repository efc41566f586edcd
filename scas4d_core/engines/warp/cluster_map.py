"""Cluster map of equation (6) for an entire layer, and its backward pass. Reference: ``engines.torch.deformation``.

Each warp processes one cluster, whose Gaussians are contiguous in hierarchy order. Pivots and parameter gradients are
therefore sums over lanes, and no atomics are needed.
"""

from __future__ import annotations

from math import e, log2

import warp as wp

from scas4d_core.engines.warp.adam import Adam, step_element
from scas4d_core.engines.warp.lanes import lane, lane_count, sum_over_lanes
from scas4d_core.engines.warp.quaternions import (
    change_of,
    conjugate,
    matrix_backward,
    matrix_of,
    of_tangent,
    of_tangent_backward,
    product,
    vector_of,
)
from scas4d_core.guards import EXPONENT, HALF_TURN

wp.set_module_options({"enable_backward": False})

LARGEST = wp.constant(wp.float32(EXPONENT / log2(e)))
"""Bound on the magnitude of exponents."""
SMALLEST_COSINE = wp.constant(wp.float32(HALF_TURN))
COLUMNS = 10
"""Number of parameters per cluster: r, t, c (three each) and s."""


@wp.struct
class ClusterParameters:
    """Parameters of a cluster, with its rotation as a unit quaternion and as a matrix."""

    r: wp.vec3
    t: wp.vec3
    c: wp.vec3
    s: wp.float32
    q: wp.vec4
    rotation: wp.mat33


@wp.func
def parameters_of(table: wp.array2d[wp.float32], cluster: wp.int32) -> ClusterParameters:
    """Reads the parameters of a cluster from a layer's table."""
    found = ClusterParameters()
    found.r = wp.vec3(table[cluster, 0], table[cluster, 1], table[cluster, 2])
    found.t = wp.vec3(table[cluster, 3], table[cluster, 4], table[cluster, 5])
    found.c = wp.vec3(table[cluster, 6], table[cluster, 7], table[cluster, 8])
    found.s = table[cluster, 9]
    found.q = of_tangent(found.r)
    found.rotation = matrix_of(found.q)
    return found


@wp.func
def pivot_of(
    start: wp.int32, end: wp.int32, sound: wp.array[wp.int32], points: wp.array[wp.vec3]
) -> wp.vec3:  # fmt: skip
    """Returns the mean of a cluster's points with finite values. All lanes receive the result."""
    total = wp.vec3(0.0, 0.0, 0.0)
    count = wp.float32(0.0)
    for entry in range(start + lane(), end, lane_count()):
        if sound[entry] == 1:
            total += points[entry]
            count += 1.0
    count = wp.max(sum_over_lanes(count), 1.0)
    return wp.vec3(sum_over_lanes(total[0]), sum_over_lanes(total[1]), sum_over_lanes(total[2])) / count


@wp.func
def scaling(z: wp.float32) -> wp.float32:
    """Returns the factor f = 2σ(2z), which equals tanh(z) + 1 without cancellation."""
    return 2.0 / (1.0 + wp.exp(wp.clamp(-2.0 * z, -LARGEST, LARGEST)))


@wp.func
def polar(f: wp.float32, y: wp.vec3, c: wp.vec3) -> wp.vec4:
    """Returns the polar rotation of f I + f (2 − f) y cᵀ as a unit quaternion."""
    g = 2.0 - f
    cosine = 2.0 + g * wp.dot(c, y)
    sine = g * wp.cross(c, y)
    radius = wp.sqrt(cosine * cosine + wp.dot(sine, sine))
    return wp.normalize(wp.vec4(wp.max(radius + cosine, SMALLEST_COSINE), sine[0], sine[1], sine[2]))


@wp.struct
class PolarGradients:
    """Gradients with respect to the arguments of ``polar``."""

    f: wp.float32
    y: wp.vec3
    c: wp.vec3


@wp.func
def polar_backward(f: wp.float32, y: wp.vec3, c: wp.vec3, g_out: wp.vec4) -> PolarGradients:
    """Backpropagates the gradient of ``polar`` to its arguments."""
    g = 2.0 - f
    along = wp.dot(c, y)
    across = wp.cross(c, y)
    cosine = 2.0 + g * along
    sine = g * across
    radius = wp.sqrt(cosine * cosine + wp.dot(sine, sine))
    raw = wp.vec4(wp.max(radius + cosine, SMALLEST_COSINE), sine[0], sine[1], sine[2])
    length = wp.length(raw)
    unit = raw / length
    g_raw = (g_out - wp.dot(unit, g_out) * unit) / length
    g_cosine = wp.float32(0.0)
    g_sine = vector_of(g_raw)
    if radius + cosine > SMALLEST_COSINE:
        g_cosine = g_raw[0] * (1.0 + cosine / radius)
        g_sine += g_raw[0] / radius * sine
    made = PolarGradients()
    made.f = -(g_cosine * along + wp.dot(g_sine, across))
    made.y = g * (g_cosine * c + wp.cross(g_sine, c))
    made.c = g * (g_cosine * y + wp.cross(y, g_sine))
    return made


@wp.kernel
def map_clusters(
    published: wp.int32,
    starts: wp.array[wp.int32],
    table: wp.array2d[wp.float32],
    sound: wp.array[wp.int32],
    points: wp.array[wp.vec3],
    jacobians: wp.array[wp.mat33],
    turns: wp.array[wp.vec4],
    pivots: wp.array[wp.vec3],
    moved: wp.array[wp.vec3],
    moved_jacobians: wp.array[wp.mat33],
    moved_turns: wp.array[wp.vec4],
) -> None:
    """Moves the Gaussians of a layer's clusters, with one warp per cluster.

    Args:
        published: 1 for the published variant of the map, 0 for the centred one.
        starts: [K + 1] first entry of each cluster, followed by the number of entries.
        table: [K, 10] parameters of the clusters.
        sound: [M] 1 for entries with finite values, otherwise 0.
        points, jacobians, turns: [M] points, Jacobians and rotations after the coarser layers.
        pivots: [K] output, pivot of each cluster.
        moved, moved_jacobians, moved_turns: [M] outputs, points, Jacobians and rotations after this layer.
    """
    cluster = wp.tid() // lane_count()
    start = starts[cluster]
    end = starts[cluster + 1]
    own = parameters_of(table, cluster)
    pivot = pivot_of(start, end, sound, points)
    if lane() == 0:
        pivots[cluster] = pivot
    for entry in range(start + lane(), end, lane_count()):
        if sound[entry] == 1:
            point = points[entry]
            offset = point - pivot
            z = wp.dot(own.c, offset) + own.s
            f = scaling(z)
            step = change_of(own.q, offset)
            placed = point + (own.t + step)
            y = offset
            grown = offset + step
            if published == 1:
                y = wp.transpose(own.rotation) * placed
                grown = placed
            moved[entry] = placed + wp.tanh(z) * grown
            inner = f * wp.identity(n=3, dtype=wp.float32) + f * (2.0 - f) * wp.outer(y, own.c)
            moved_jacobians[entry] = own.rotation * inner * jacobians[entry]
            moved_turns[entry] = product(product(own.q, polar(f, y, own.c)), turns[entry])


@wp.kernel
def map_clusters_backward(
    published: wp.int32,
    starts: wp.array[wp.int32],
    table: wp.array2d[wp.float32],
    sound: wp.array[wp.int32],
    points: wp.array[wp.vec3],
    jacobians: wp.array[wp.mat33],
    turns: wp.array[wp.vec4],
    pivots: wp.array[wp.vec3],
    g_points: wp.array[wp.vec3],
    g_jacobians: wp.array[wp.mat33],
    g_turns: wp.array[wp.vec4],
    g_table: wp.array2d[wp.float32],
    adam: Adam,
) -> None:
    """Backpropagates through a layer to its inputs and parameters, and takes an Adam step for the parameters.

    Args:
        published, starts, table, sound, points, jacobians, turns, pivots: see ``map_clusters``.
        g_points, g_jacobians, g_turns: [M] gradients of the layer's outputs, replaced by the gradients of its inputs.
        g_table: [K, 10] output, gradients of the parameters.
        adam: optimizer for the table.
    """
    cluster = wp.tid() // lane_count()
    own = parameters_of(table, cluster)
    pivot = pivots[cluster]
    back = wp.transpose(own.rotation)
    g_q = wp.vec4(0.0, 0.0, 0.0, 0.0)
    g_t = wp.vec3(0.0, 0.0, 0.0)
    g_c = wp.vec3(0.0, 0.0, 0.0)
    g_s = wp.float32(0.0)
    for entry in range(starts[cluster] + lane(), starts[cluster + 1], lane_count()):
        if sound[entry] == 1:
            point = points[entry]
            offset = point - pivot
            z = wp.dot(own.c, offset) + own.s
            f = scaling(z)
            slope = f * (2.0 - f)
            step = change_of(own.q, offset)
            placed = point + (own.t + step)
            y = offset
            if published == 1:
                y = back * placed
            inner = f * wp.identity(n=3, dtype=wp.float32) + slope * wp.outer(y, own.c)
            # Rotation: q ∘ polar ∘ rotation after the coarser layers.
            bent = polar(f, y, own.c)
            g_here = product(g_turns[entry], conjugate(turns[entry]))
            g_turns[entry] = product(conjugate(product(own.q, bent)), g_turns[entry])
            g_q += product(g_here, conjugate(bent))
            of_polar = polar_backward(f, y, own.c, product(conjugate(own.q), g_here))
            # Jacobian: R (f I + f' y cᵀ) J, with J from the coarser layers.
            g_own = g_jacobians[entry] * wp.transpose(jacobians[entry])
            g_jacobians[entry] = wp.transpose(inner) * back * g_jacobians[entry]
            g_rotation = g_own * wp.transpose(inner)
            g_inner = back * g_own
            g_f = of_polar.f + wp.trace(g_inner) + (2.0 - 2.0 * f) * wp.dot(y, g_inner * own.c)
            g_y = of_polar.y + slope * (g_inner * own.c)
            g_c += of_polar.c + slope * (wp.transpose(g_inner) * y)
            # Point.
            g_moved = g_points[entry]
            g_placed = g_moved
            g_offset = wp.vec3(0.0, 0.0, 0.0)
            g_step = wp.vec3(0.0, 0.0, 0.0)
            if published == 1:
                g_f += wp.dot(g_moved, placed)
                g_placed = f * g_moved + own.rotation * g_y
                g_rotation += wp.outer(placed, g_y)
            else:
                g_f += wp.dot(g_moved, offset + step)
                g_step = wp.tanh(z) * g_moved
                g_offset = g_step + g_y
            g_step += g_placed
            g_t += g_placed
            g_rotation += wp.outer(g_step, offset)
            g_z = g_f * slope
            g_s += g_z
            g_c += g_z * offset
            g_offset += back * g_step - g_step + g_z * own.c
            g_points[entry] = g_placed + g_offset
            g_q += matrix_backward(own.q, g_rotation)
    for k in range(4):
        g_q[k] = sum_over_lanes(g_q[k])
    for k in range(3):
        g_t[k] = sum_over_lanes(g_t[k])
        g_c[k] = sum_over_lanes(g_c[k])
    g_s = sum_over_lanes(g_s)
    if lane() == 0:
        g_r = of_tangent_backward(own.r, g_q)
        for k in range(3):
            g_table[cluster, k] = g_r[k]
            g_table[cluster, 3 + k] = g_t[k]
            g_table[cluster, 6 + k] = g_c[k]
        g_table[cluster, 9] = g_s
        for k in range(10):
            step_element(adam, table, cluster, k, g_table[cluster, k])
