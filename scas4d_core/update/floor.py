"""The floor: nothing that moves sinks into it (Dynamic3DGaussians' floor loss, for a floor of any pose).

Numpy; its twin is ``losses.floor_loss``. Only a scene that names a floor has the term.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import WorldFrame

Array = NDArray[np.float32]
Plane = tuple[float, float, float, float]


def floor_inside(plane: Sequence[float], world: WorldFrame) -> Plane:
    """A plane (a, b, c, d) of the user's world as the inside world has it.

    Positive values of a·x + b·y + c·z + d lie below the floor; inside, they are metres.

    Raises:
        ValueError: (a, b, c) is no direction.
    """
    normal = np.asarray(plane[:3], dtype=np.float64)
    length = float(np.linalg.norm(normal))
    if not length > 0:
        raise ValueError(f"floor {tuple(plane)} has no direction; give (a, b, c, d) with (a, b, c) pointing down")
    normal = normal / length
    offset = (float(normal @ world.origin) + plane[3] / length) * world.metres_per_unit
    return float(normal[0]), float(normal[1]), float(normal[2]), offset


def floor_term(plane: Plane, means: Array, rows: NDArray[np.int64], weight: float, g_means: Array) -> float:
    """The weighted mean depth below the floor; its gradient is added to ``g_means``.

    Args:
        plane: from ``floor_inside``. means [N, 3] metres. rows: [M] the moving Gaussians.
        g_means: [N, 3], added to.
    """
    if len(rows) == 0:
        return 0.0
    normal = np.array(plane[:3], np.float32)
    depth = means[rows] @ normal + np.float32(plane[3])
    below = rows[depth > 0]
    g_means[below] += np.float32(weight / len(rows)) * normal
    return float(weight * np.maximum(depth, 0).mean())
