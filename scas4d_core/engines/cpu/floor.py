"""Floor loss, which keeps moving Gaussians above a plane (from Dynamic3DGaussians, extended to arbitrary planes)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.plan import Plane

Array = NDArray[np.float32]


def floor_term(plane: Plane, means: Array, rows: NDArray[np.int64], weight: float, g_means: Array) -> float:
    """Returns the weighted mean depth below the floor, and adds its gradient to ``g_means``.

    Args:
        plane: floor plane; see ``UpdatePlan.floor``.
        means: [N, 3] means, in metres.
        rows: [M] rows of the moving Gaussians.
        weight: weight of the loss.
        g_means: [N, 3] gradients of the means, to which the gradient of this loss is added.
    """
    if len(rows) == 0:
        return 0.0
    normal = np.array(plane[:3], np.float32)
    depth = means[rows] @ normal + np.float32(plane[3])
    below = depth > 0  # NaN compares as False
    g_means[rows[below]] += np.float32(weight / len(rows)) * normal
    return float(weight * depth[below].sum(dtype=np.float64) / len(rows))
