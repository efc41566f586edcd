"""Rigidity, isometry and rotation losses between neighbours, with gradients. Reference: ``engines.torch.losses``."""

from __future__ import annotations

import warp as wp

from scas4d_core.engines.warp.quaternions import matrix_backward, matrix_of
from scas4d_core.guards import ROOT_FLOOR

wp.set_module_options({"enable_backward": False})

FLOOR = wp.constant(wp.float32(ROOT_FLOOR))


@wp.kernel
def weigh_pairs(
    squares: wp.array2d[wp.float64],
    falloff: wp.float64,
    distances: wp.array2d[wp.float32],
    weights: wp.array2d[wp.float32],
) -> None:
    """Computes the distances and weights of neighbours as ``structure.neighbours``, with one thread per pair.

    Args:
        squares: [M, k] squared distances in m², which are infinite for unused pairs.
        falloff: decay of the weights in 1/m².
        distances, weights: [M, k] outputs, which are 0 for unused pairs.
    """
    i, k = wp.tid()
    square = squares[i, k]
    if wp.isfinite(square):
        distances[i, k] = wp.float32(wp.sqrt(square))
        weights[i, k] = wp.float32(wp.exp(-falloff * square))


@wp.kernel
def neighbour_terms(
    weights: wp.array[wp.float32],
    samples: wp.array2d[wp.int32],
    sample: wp.array[wp.int32],
    sound: wp.array[wp.int32],
    neighbours: wp.array2d[wp.int32],
    pair_weights: wp.array2d[wp.float32],
    distances: wp.array2d[wp.float32],
    rows: wp.array[wp.int32],
    previous: wp.array[wp.vec3],
    means: wp.array[wp.vec3],
    turns: wp.array[wp.vec4],
    tied_means: wp.array[wp.vec3],
    tied_turns: wp.array[wp.vec4],
    iteration: wp.array[wp.int32],
    losses: wp.array[wp.float32],
) -> None:
    """Accumulates the three losses and their gradients, with one thread per sampled Gaussian.

    Square roots are exact. Without motion, all differences are rounding errors, which a fast square root would turn
    into full-size gradients.

    Args:
        weights: [3] weights of rigidity, isometry and rotation per pair. A weight of 0 disables a loss.
        samples: [samples, S] entries of the sampled Gaussians. Shorter samples are padded with −1.
        sample: [1] index of the current sample.
        sound: [M] 1 for entries with finite values, otherwise 0.
        neighbours: [M, k] neighbours of each Gaussian.
        pair_weights: [M, k] weights of the pairs, which are 0 for unused pairs.
        distances: [M, k] distances of the pairs when the graph was built, in metres.
        rows: [M] rows of the moving Gaussians in Θ_t.
        previous: [N] means of Θ_{t−1}.
        means: [N] deformed means.
        turns: [M] rotations since Θ_{t−1}.
        tied_means, tied_turns: [M] outputs, gradients of means and rotations, accumulated.
        iteration: [1] row of ``losses`` for this iteration.
        losses: weighted losses of each iteration, to which the three losses are added.
    """
    i = samples[sample[0], wp.tid()]
    if i < 0:
        return
    if sound[i] == 0:
        return
    here = wp.float32(0.0)
    turn = turns[i]
    rotation = matrix_of(turn)
    mean = means[rows[i]]
    before = previous[rows[i]]
    g_mean = wp.vec3(0.0, 0.0, 0.0)
    g_turn = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for k in range(neighbours.shape[1]):
        weight = pair_weights[i, k]
        j = neighbours[i, k]
        if weight > 0.0 and sound[j] == 1:
            g_other = wp.vec3(0.0, 0.0, 0.0)
            offset = means[rows[j]] - mean
            if weights[0] > 0.0:
                change = wp.transpose(rotation) * offset - (previous[rows[j]] - before)
                size = wp.sqrt(weight * wp.dot(change, change) + FLOOR)
                here += weights[0] * size
                g_change = weights[0] * weight / size * change
                g_other += rotation * g_change
                g_turn += matrix_backward(turn, wp.outer(offset, g_change))
            if weights[1] > 0.0:
                distance = wp.sqrt(wp.dot(offset, offset) + FLOOR)
                longer = distance - distances[i, k]
                size = wp.sqrt(weight * longer * longer + FLOOR)
                here += weights[1] * size
                g_other += weights[1] * weight * longer / size / distance * offset
            if weights[2] > 0.0:
                apart = turns[j] - turn
                size = wp.sqrt(weight * wp.dot(apart, apart) + FLOOR)
                here += weights[2] * size
                g_apart = weights[2] * weight / size * apart
                g_turn -= g_apart
                wp.atomic_add(tied_turns, j, g_apart)
            g_mean -= g_other
            wp.atomic_add(tied_means, j, g_other)
    wp.atomic_add(tied_means, i, g_mean)
    wp.atomic_add(tied_turns, i, g_turn)
    wp.atomic_add(losses, iteration[0], here)
