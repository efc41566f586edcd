"""Activation functions that convert fit parameters to rasterizer inputs, and their backward pass.

    F = R(q/|q|) diag(exp s),    opacity = sigmoid(o),    label = sigmoid(m)

A zero quaternion is treated as the identity; see ``guards.QUATERNION_FLOOR``. The reference
implementation in PyTorch is part of the tests.
"""

from __future__ import annotations

import numpy as np
from numba import prange
from numpy.typing import NDArray

from scas4d_core.guards import EXPONENT, QUATERNION_FLOOR
from scas4d_core.kernels.cascade import rotation_entries, rotation_gradient
from scas4d_core.kernels.jit import LOG2_E, ONE, ZERO, exp, inline, parallel_kernel

CHUNK = 256

# Columns of a parameter row: mean 0–2, quaternion 3–6, log scale 7–9, opacity logit 10, colour 11–13, label 14.
COLUMNS = 15


SHORTEST = np.float32(QUATERNION_FLOOR)
LARGEST = np.float32(EXPONENT) / LOG2_E

COUNTED_GUARDS = ("quaternion_floor", "exponent")
"""Names of the guards that ``activate`` counts."""


def activate(
    parameters: NDArray[np.float32],
    means: NDArray[np.float32],
    factors: NDArray[np.float32],
    opacities: NDArray[np.float32],
    features: NDArray[np.float32],
) -> NDArray[np.int64]:
    """Computes the rasterizer inputs from the parameters of a fit.

    Args:
        parameters: [N, 15] parameters.
        means: [N, 3] output, in metres.
        factors: [N, 3, 3] output, covariance factors.
        opacities: [N] output.
        features: [N, 4] output, RGB and label.

    Returns:
        [2] number of Gaussians that triggered each guard in ``COUNTED_GUARDS``.
    """
    guard_counts = np.zeros((-(-len(parameters) // CHUNK), len(COUNTED_GUARDS)), np.int64)
    activate_rows(parameters, means, factors, opacities, features, guard_counts)
    total: NDArray[np.int64] = guard_counts.sum(axis=0)
    return total


@inline
def direction(p):
    """Returns the unit quaternion of a parameter row, and the inverse norm of the parameters.

    For a zero quaternion, the result is the identity and 0.
    """
    square = p[3] * p[3] + p[4] * p[4] + p[5] * p[5] + p[6] * p[6]
    directed = square > SHORTEST
    norm = ONE / np.float32(np.sqrt(square)) if directed else ZERO
    w = p[3] * norm if directed else ONE
    x = p[4] * norm if directed else ZERO
    y = p[5] * norm if directed else ZERO
    z = p[6] * norm if directed else ZERO
    return w, x, y, z, norm


@parallel_kernel
def activate_rows(parameters, means, factors, opacities, features, guard_counts):
    """Implements ``activate`` with parallel tasks, which fill ``guard_counts`` [tasks, 2]."""
    count = parameters.shape[0]
    for task in prange((count + CHUNK - 1) // CHUNK):
        aimless = clamped = 0
        for i in range(task * CHUNK, min(count, (task + 1) * CHUNK)):
            p = parameters[i]
            w, x, y, z, norm = direction(p)
            aimless += norm == ZERO
            largest = max(max(abs(p[7]), abs(p[8])), max(max(abs(p[9]), abs(p[10])), abs(p[14])))
            clamped += largest > LARGEST
            entries = rotation_entries(w, x, y, z)
            for column in range(3):
                means[i, column] = p[column]
                scale = exp(p[7 + column])
                factors[i, 0, column] = entries[column] * scale
                factors[i, 1, column] = entries[3 + column] * scale
                factors[i, 2, column] = entries[6 + column] * scale
                features[i, column] = p[11 + column]
            opacities[i] = ONE / (ONE + exp(-p[10]))
            features[i, 3] = ONE / (ONE + exp(-p[14]))
        guard_counts[task, 0] = aimless
        guard_counts[task, 1] = clamped


@parallel_kernel
def activate_backward(parameters, factors, opacities, features, g_means, g_factors, g_opacities, g_features, gradients):
    """Computes dL/dparameters, ``gradients`` [N, 15], from the gradients of the outputs."""
    count = parameters.shape[0]
    for task in prange((count + CHUNK - 1) // CHUNK):
        for i in range(task * CHUNK, min(count, (task + 1) * CHUNK)):
            p = parameters[i]
            w, x, y, z, norm = direction(p)
            s0, s1, s2 = exp(p[7]), exp(p[8]), exp(p[9])
            g = g_factors[i]
            gw, gx, gy, gz = rotation_gradient(
                w, x, y, z, g[0, 0] * s0, g[0, 1] * s1, g[0, 2] * s2, g[1, 0] * s0, g[1, 1] * s1, g[1, 2] * s2,
                g[2, 0] * s0, g[2, 1] * s1, g[2, 2] * s2,
            )  # fmt: skip
            along = w * gw + x * gx + y * gy + z * gz
            gradients[i, 3] = (gw - w * along) * norm
            gradients[i, 4] = (gx - x * along) * norm
            gradients[i, 5] = (gy - y * along) * norm
            gradients[i, 6] = (gz - z * along) * norm
            for column in range(3):
                gradients[i, column] = g_means[i, column]
                total = ZERO
                for row in range(3):
                    total += g[row, column] * factors[i, row, column]
                gradients[i, 7 + column] = total if abs(p[7 + column]) <= LARGEST else ZERO
                gradients[i, 11 + column] = g_features[i, column]
            gradients[i, 10] = g_opacities[i] * opacities[i] * (ONE - opacities[i])
            gradients[i, 14] = g_features[i, 3] * features[i, 3] * (ONE - features[i, 3])
