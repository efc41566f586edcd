"""Per-Gaussian deltas of equation (5), with the scale and floor losses. Reference: ``engines.torch``."""

from __future__ import annotations

import warp as wp

from scas4d_core.engines.plan import MAX_SCALE
from scas4d_core.engines.warp.adam import Adam, step_element
from scas4d_core.engines.warp.cluster_map import LARGEST
from scas4d_core.engines.warp.quaternions import (
    conjugate,
    matrix_backward,
    matrix_of,
    of_tangent,
    of_tangent_backward,
    product,
)

wp.set_module_options({"enable_backward": False})

SMALLEST_BOUND = wp.constant(wp.float32(MAX_SCALE))


@wp.struct
class Terms:
    """Weights and constants of the per-Gaussian losses.

    Attributes:
        separate: 1 if the Jacobian does not transform the covariance, otherwise 0.
        axis_length: weight of the scale loss per axis. A weight of 0 disables the loss.
        floor: weight of the floor loss per Gaussian. A weight of 0 disables the loss.
        plane: floor plane; see ``UpdatePlan.floor``.
    """

    separate: wp.int32
    axis_length: wp.float32
    floor: wp.float32
    plane: wp.vec4


@wp.func
def delta(deltas: wp.array2d[wp.float32], entry: wp.int32, first: wp.int32) -> wp.vec3:
    """Returns three columns of a Gaussian's deltas, starting at column ``first``."""
    return wp.vec3(deltas[entry, first], deltas[entry, first + 1], deltas[entry, first + 2])


@wp.func
def stretch(ds: wp.vec3) -> wp.mat33:
    """Returns diag(exp Δs), with clamped exponents."""
    return wp.diag(
        wp.vec3(
            wp.exp(wp.clamp(ds[0], -LARGEST, LARGEST)),
            wp.exp(wp.clamp(ds[1], -LARGEST, LARGEST)),
            wp.exp(wp.clamp(ds[2], -LARGEST, LARGEST)),
        )
    )


@wp.kernel
def find_entries(
    rows: wp.array[wp.int32], roots: wp.array[wp.vec3], entries: wp.array[wp.int32], own: wp.array[wp.vec3]
) -> None:
    """Inverts ``rows`` and gathers the roots of the moving Gaussians, with one thread per moving Gaussian.

    Args:
        rows: [M] rows of the moving Gaussians.
        roots: [N] positions in frame 0.
        entries: [N] output, index of each moving Gaussian in ``rows``.
        own: [M] output, positions of the moving Gaussians in frame 0.
    """
    entry = wp.tid()
    entries[rows[entry]] = entry
    own[entry] = roots[rows[entry]]


@wp.kernel
def take_moving(
    rows: wp.array[wp.int32],
    previous_means: wp.array[wp.vec3],
    previous_factors: wp.array[wp.mat33],
    sound: wp.array[wp.int32],
    points: wp.array[wp.vec3],
    turns: wp.array[wp.vec4],
    unsound: wp.array[wp.int32],
) -> None:
    """Gathers the moving Gaussians of Θ_{t−1}, with one thread per Gaussian.

    Args:
        rows: [M] rows of the moving Gaussians in Θ_{t−1}.
        previous_means, previous_factors: [N] means and factors of Θ_{t−1}.
        sound: [M] output, 1 for entries with finite values, otherwise 0.
        points: [M] output, means of the moving Gaussians.
        turns: [M] output, identity quaternions.
        unsound: [1] number of entries with non-finite values, accumulated.
    """
    entry = wp.tid()
    mean = previous_means[rows[entry]]
    points[entry] = mean
    turns[entry] = wp.vec4(1.0, 0.0, 0.0, 0.0)
    sound[entry] = 1
    if not (wp.isfinite(mean) and wp.isfinite(previous_factors[rows[entry]])):
        sound[entry] = 0
        wp.atomic_add(unsound, 0, 1)


@wp.kernel
def apply_deltas(
    terms: Terms,
    rows: wp.array[wp.int32],
    sound: wp.array[wp.int32],
    points: wp.array[wp.vec3],
    jacobians: wp.array[wp.mat33],
    turned: wp.array[wp.vec4],
    previous_factors: wp.array[wp.mat33],
    deltas: wp.array2d[wp.float32],
    means: wp.array[wp.vec3],
    factors: wp.array[wp.mat33],
    turns: wp.array[wp.vec4],
    tied_means: wp.array[wp.vec3],
    tied_turns: wp.array[wp.vec4],
) -> None:
    """Applies Δp, ΔR and Δs after the cascade, with one thread per moving Gaussian.

    Args:
        terms: constants, of which only ``separate`` is used.
        rows: [M] rows of the moving Gaussians in Θ_t.
        sound: [M] 1 for Gaussians with finite values, otherwise 0. All other Gaussians remain unchanged.
        points, jacobians, turned: [M] points, Jacobians and rotations after the cascade.
        previous_factors: [N] covariance factors of Θ_{t−1}.
        deltas: [M, 9] per-Gaussian deltas.
        means, factors: [N] outputs, written at ``rows``.
        turns: [M] output, rotations since Θ_{t−1} as unit quaternions with w ≥ 0.
        tied_means, tied_turns: [M] gradients of the neighbour terms, reset to 0.
    """
    entry = wp.tid()
    tied_means[entry] = wp.vec3(0.0, 0.0, 0.0)
    tied_turns[entry] = wp.vec4(0.0, 0.0, 0.0, 0.0)
    if sound[entry] == 1:
        row = rows[entry]
        q = of_tangent(delta(deltas, entry, 3))
        carried = matrix_of(q)
        if terms.separate == 0:
            carried = carried * jacobians[entry]
        means[row] = points[entry] + delta(deltas, entry, 0)
        factors[row] = carried * previous_factors[row] * stretch(delta(deltas, entry, 6))
        turn = product(q, turned[entry])
        turns[entry] = wp.where(turn[0] < 0.0, -turn, turn)


@wp.kernel
def apply_deltas_backward(
    terms: Terms,
    rows: wp.array[wp.int32],
    sound: wp.array[wp.int32],
    jacobians: wp.array[wp.mat33],
    turned: wp.array[wp.vec4],
    previous_factors: wp.array[wp.mat33],
    deltas: wp.array2d[wp.float32],
    first_lengths: wp.array[wp.vec3],
    means: wp.array[wp.vec3],
    factors: wp.array[wp.mat33],
    g_means: wp.array[wp.vec3],
    g_factors: wp.array[wp.mat33],
    tied_means: wp.array[wp.vec3],
    tied_turns: wp.array[wp.vec4],
    g_points: wp.array[wp.vec3],
    g_jacobians: wp.array[wp.mat33],
    g_turned: wp.array[wp.vec4],
    g_deltas: wp.array2d[wp.float32],
    adam: Adam,
    iteration: wp.array[wp.int32],
    losses: wp.array[wp.float32],
) -> None:
    """Backpropagates through ``apply_deltas``, and takes an Adam step for the deltas.

    The kernel also adds the scale and floor losses and their gradients.

    Args:
        terms, rows, sound, jacobians, turned, previous_factors, deltas: see ``apply_deltas``.
        first_lengths: [N] axis lengths in frame 0 in metres, above which the scale loss (equation (8)) applies.
        means, factors: [N] deformed means and factors.
        g_means, g_factors: [N] gradients of the rendering losses.
        tied_means, tied_turns: [M] gradients of the neighbour terms.
        g_points, g_jacobians, g_turned: [M] outputs, gradients of the cascade's results.
        g_deltas: [M, 9] output, gradients of the deltas.
        adam: optimizer for the deltas.
        iteration: [1] row of ``losses`` for this iteration.
        losses: weighted losses of each iteration, to which the scale and floor losses are added.
    """
    entry = wp.tid()
    if sound[entry] == 0:
        for k in range(9):
            g_deltas[entry, k] = 0.0
        return
    row = rows[entry]
    here = wp.float32(0.0)
    g_mean = g_means[row] + tied_means[entry]
    depth = wp.dot(means[row], wp.vec3(terms.plane[0], terms.plane[1], terms.plane[2])) + terms.plane[3]
    if terms.floor > 0.0 and depth > 0.0:
        here += terms.floor * depth
        g_mean += terms.floor * wp.vec3(terms.plane[0], terms.plane[1], terms.plane[2])
    factor = factors[row]
    g_factor = g_factors[row]
    if terms.axis_length > 0.0:
        for axis in range(3):
            column = wp.vec3(factor[0, axis], factor[1, axis], factor[2, axis])
            length = wp.length(column)
            excess = length - wp.max(first_lengths[row][axis], SMALLEST_BOUND)
            if excess > 0.0:
                here += terms.axis_length * excess
                for k in range(3):
                    g_factor[k, axis] = g_factor[k, axis] + terms.axis_length * column[k] / length
    dr = delta(deltas, entry, 3)
    ds = delta(deltas, entry, 6)
    q = of_tangent(dr)
    rotation = matrix_of(q)
    # F = R(Δr) C with C = J F_previous diag(exp Δs).
    g_carried = wp.transpose(rotation) * g_factor
    carried = wp.transpose(rotation) * factor
    g_q = matrix_backward(q, g_factor * wp.transpose(carried))
    for axis in range(3):
        along = wp.float32(0.0)
        for k in range(3):
            along += g_carried[k, axis] * carried[k, axis]
        g_deltas[entry, 6 + axis] = wp.where(wp.abs(ds[axis]) <= LARGEST, along, 0.0)
    g_jacobian = wp.mat33(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    if terms.separate == 0:
        g_jacobian = g_carried * wp.transpose(previous_factors[row] * stretch(ds))
    turn = product(q, turned[entry])
    g_turn = tied_turns[entry]
    if turn[0] < 0.0:
        g_turn = -g_turn
    g_q += product(g_turn, conjugate(turned[entry]))
    g_r = of_tangent_backward(dr, g_q)
    for k in range(3):
        g_deltas[entry, k] = g_mean[k]
        g_deltas[entry, 3 + k] = g_r[k]
    for k in range(9):
        step_element(adam, deltas, entry, k, g_deltas[entry, k])
    g_points[entry] = g_mean
    g_jacobians[entry] = g_jacobian
    g_turned[entry] = product(conjugate(q), g_turn)
    if here != 0.0:
        wp.atomic_add(losses, iteration[0], here)
