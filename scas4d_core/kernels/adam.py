"""A step of Adam (Kingma and Ba 2015) over a table of parameters, a rate per column. Twin: ``torch.optim.Adam``."""

from __future__ import annotations

import numpy as np
from numba import prange

from scas4d_core.kernels.jit import ONE, parallel_kernel

EPSILON = np.float32(1e-15)
"""As in Dynamic3DGaussians: gradients of single Gaussians are far below the usual 1e-8."""

SMALLEST = np.float32(1e-19)
"""Gradients below are taken as 0: their squares would be denormal, which costs tens of times a normal number."""

EVERY_ROW = np.ones(1, np.float32)
"""All rows alike."""

ROWS = 1024


@parallel_kernel
def adam(parameters, gradients, first, second, rates, by_row, beta1, beta2, step):
    """Update ``parameters`` [n, columns] in place.

    Args:
        gradients, first, second: [n, columns]; the moments are updated in place. rates: [columns].
        by_row: [n], what the rates of each row are multiplied with, or ``EVERY_ROW``.
        beta1, beta2: decays (float32). step: 1 for the first update.
    """
    rows, columns = parameters.shape
    correction1 = ONE - np.float32(beta1**step)
    correction2 = ONE - np.float32(beta2**step)
    for task in prange((rows + ROWS - 1) // ROWS):
        for i in range(task * ROWS, min(rows, (task + 1) * ROWS)):
            row = by_row[i] if by_row.shape[0] > 1 else by_row[0]
            for k in range(columns):
                g = gradients[i, k]
                g = g if abs(g) > SMALLEST else np.float32(0.0)
                m = beta1 * first[i, k] + (ONE - beta1) * g
                v = beta2 * second[i, k] + (ONE - beta2) * g * g
                m = m if abs(m) > SMALLEST else np.float32(0.0)
                v = v if v > SMALLEST * SMALLEST else np.float32(0.0)
                first[i, k] = m
                second[i, k] = v
                parameters[i, k] -= row * rates[k] * (m / correction1) / (np.sqrt(v / correction2) + EPSILON)
