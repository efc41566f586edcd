"""Activation functions for a fit's parameters, with backward pass and Adam step. Reference: ``kernels.activation``."""

from __future__ import annotations

import warp as wp

from scas4d_core.engines.warp.adam import Adam, step_element
from scas4d_core.engines.warp.cluster_map import LARGEST
from scas4d_core.engines.warp.lanes import load
from scas4d_core.engines.warp.layout import Camera
from scas4d_core.engines.warp.projection import RECORD
from scas4d_core.engines.warp.quaternions import matrix_backward, matrix_of
from scas4d_core.guards import QUATERNION_FLOOR

wp.set_module_options({"enable_backward": False})

SHORTEST = wp.constant(wp.float32(QUATERNION_FLOOR))


@wp.func
def clamped_exp(x: wp.float32) -> wp.float32:
    """Returns exp(x), with x clamped to avoid overflow."""
    return wp.exp(wp.clamp(x, -LARGEST, LARGEST))


@wp.func
def quaternion_of(parameters: wp.array2d[wp.float32], i: wp.int32) -> wp.vec4:
    """Returns the unnormalized quaternion of row ``i``."""
    return wp.vec4(parameters[i, 3], parameters[i, 4], parameters[i, 5], parameters[i, 6])


@wp.func
def inverse_norm(q: wp.vec4) -> wp.float32:
    """Returns 1/|q|, or 0 if q is so short that it is treated as the identity."""
    square = wp.dot(q, q)
    inverse = wp.float32(0.0)
    if square > SHORTEST:
        inverse = 1.0 / wp.sqrt(square)
    return inverse


@wp.func
def unit(q: wp.vec4, inverse: wp.float32) -> wp.vec4:
    """Returns q, normalized with the result of ``inverse_norm``."""
    return wp.where(inverse > 0.0, inverse * q, wp.vec4(1.0, 0.0, 0.0, 0.0))


@wp.func
def scales_of(parameters: wp.array2d[wp.float32], i: wp.int32) -> wp.vec3:
    """Returns the axis lengths of the Gaussian in row ``i``, in metres."""
    return wp.vec3(clamped_exp(parameters[i, 7]), clamped_exp(parameters[i, 8]), clamped_exp(parameters[i, 9]))


@wp.kernel
def activate(
    fixed: wp.int32,
    parameters: wp.array2d[wp.float32],
    means: wp.array[wp.vec3],
    factors: wp.array[wp.mat33],
    opacities: wp.array[wp.float32],
    features: wp.array[wp.vec4],
) -> None:
    """Computes the rasterizer inputs of the fitted Gaussians, with one thread per Gaussian.

    Args:
        fixed: number of fixed Gaussians, which precede the fitted ones.
        parameters: [N, 15] parameters; see ``engines.fit`` for the columns.
        means, factors, opacities, features: [fixed + N] outputs. The first ``fixed`` rows stay unchanged.
    """
    i = wp.tid()
    row = fixed + i
    q = quaternion_of(parameters, i)
    means[row] = wp.vec3(parameters[i, 0], parameters[i, 1], parameters[i, 2])
    factors[row] = matrix_of(unit(q, inverse_norm(q))) * wp.diag(scales_of(parameters, i))
    opacities[row] = 1.0 / (1.0 + clamped_exp(-parameters[i, 10]))
    label = 1.0 / (1.0 + clamped_exp(-parameters[i, 14]))
    features[row] = wp.vec4(parameters[i, 11], parameters[i, 12], parameters[i, 13], label)


@wp.kernel
def step_parameters(
    fixed: wp.int32,
    cameras: wp.array[Camera],
    view: wp.array[wp.int32],
    splats: wp.array[wp.vec4],
    records: wp.array[wp.vec4],
    factors: wp.array[wp.mat33],
    opacities: wp.array[wp.float32],
    features: wp.array[wp.vec4],
    g_means: wp.array[wp.vec3],
    g_factors: wp.array[wp.mat33],
    g_features: wp.array[wp.vec4],
    adam: Adam,
    parameters: wp.array2d[wp.float32],
    screen_gradients: wp.array[wp.float32],
    rendered: wp.array[wp.int32],
) -> None:
    """Backpropagates through the activations and takes an Adam step, with one thread per fitted Gaussian.

    Args:
        fixed, parameters, factors, opacities, features: see ``activate``.
        cameras: [views] cameras of all views.
        view: [1] index of the rendered view.
        splats, records: rasterizer buffers after the backward pass; see ``projection``.
        g_means, g_factors, g_features: [fixed + N] gradients of the rendering loss.
        adam: optimizer for the parameters.
        screen_gradients, rendered: [N] statistics, accumulated; see ``engines.fit.RenderingStatistics``.
    """
    i = wp.tid()
    row = fixed + i
    second = load(splats, 2 * row + 1)
    r0 = load(records, RECORD * row)
    if second[2] > 0.0 and adam.scalars[0] > 0.0:  # 0: the image is incomplete and is rendered again
        first = load(splats, 2 * row)
        camera = cameras[view[0]]
        x = 0.5 * wp.float32(camera.width) * (first[2] * r0[1] + first[3] * r0[2])
        y = 0.5 * wp.float32(camera.height) * (first[3] * r0[1] + second[0] * r0[2])
        screen_gradients[i] = screen_gradients[i] + wp.sqrt(x * x + y * y)
        rendered[i] = rendered[i] + 1
    q = quaternion_of(parameters, i)
    inverse = inverse_norm(q)
    q = unit(q, inverse)
    g_mean = g_means[row]
    g_factor = g_factors[row]
    g_q = matrix_backward(q, g_factor * wp.diag(scales_of(parameters, i)))
    g_q = inverse * (g_q - wp.dot(q, g_q) * q)
    g_feature = g_features[row]
    feature = features[row]
    factor = factors[row]
    for k in range(3):
        along = wp.float32(0.0)
        for other in range(3):
            along += g_factor[other, k] * factor[other, k]
        along = wp.where(wp.abs(parameters[i, 7 + k]) <= LARGEST, along, 0.0)
        step_element(adam, parameters, i, k, g_mean[k])
        step_element(adam, parameters, i, 7 + k, along)
        step_element(adam, parameters, i, 11 + k, g_feature[k])
    for k in range(4):
        step_element(adam, parameters, i, 3 + k, g_q[k])
    # The first value of a record is the gradient with respect to the log opacity.
    step_element(adam, parameters, i, 10, wp.where(second[2] > 0.0, r0[0], 0.0) * (1.0 - opacities[row]))
    step_element(adam, parameters, i, 14, g_feature[3] * feature[3] * (1.0 - feature[3]))
