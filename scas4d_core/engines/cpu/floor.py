"""Floor loss: keeps moving Gaussians above a plane (Dynamic3DGaussians' floor loss, for arbitrary planes)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.plan import Plane

Array = NDArray[np.float32]


def floor_term(plane: Plane, means: Array, rows: NDArray[np.int64], weight: float, g_means: Array) -> float:
    """Returns the weighted mean depth below the floor, and adds its gradient to ``g_means``.

    Args:
        plane: see ``UpdatePlan.floor``. means: [N, 3] metres. rows: [M] moving Gaussians. g_means: [N, 3], added to.
    """
    if len(rows) == 0:
        return 0.0
    normal = np.array(plane[:3], np.float32)
    depth = means[rows] @ normal + np.float32(plane[3])
    below = depth > 0  # False for Gaussians that are not finite
    g_means[rows[below]] += np.float32(weight / len(rows)) * normal
    return float(weight * depth[below].sum(dtype=np.float64) / len(rows))
