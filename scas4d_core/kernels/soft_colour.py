"""Gradient of the colours: rendering gradient plus that of the soft-colour loss (Dynamic3DGaussians).

The reference implementation is ``engines.torch.losses``.
"""

from __future__ import annotations

import numpy as np

from scas4d_core.kernels.jit import kernel


@kernel
def soft_colour(colours, before, rows, g_features, weight, gradients):
    """Computes the gradient of colours, and the soft-colour loss.

    One thread suffices, because the memory bandwidth is the limit.

    Args:
        colours: [n, 3] float32 RGB colours.
        before: [n, 3] colours of the previous frame.
        rows: [n] int64 row of each colour in ``g_features``, or [0] if the rows are the same.
        g_features: [N, 4] gradients of the rendering losses with respect to the features.
        weight: weight of the soft-colour loss, float32.
        gradients: [n, 3] output.

    Returns:
        Unweighted loss Σ |colours − before|.
    """
    totals = np.zeros(3)  # a single sum would wait for each addition
    for i in range(colours.shape[0]):
        row = i if rows.shape[0] == 0 else rows[i]
        for channel in range(3):
            change = colours[i, channel] - before[i, channel]
            totals[channel] += abs(change)
            gradients[i, channel] = g_features[row, channel] + weight * np.sign(change)
    return totals.sum()
