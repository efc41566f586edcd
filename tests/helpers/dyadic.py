"""A rig whose numbers are short binary fractions: what is exact outside stays exact inside."""

from __future__ import annotations

import numpy as np
from box_scene import SIZE

from scas4d_core.cameras import Camera, Rig


def dyadic_rig() -> Rig:
    """Eight cameras whose numbers are short binary fractions and whose axes are the world's.

    Sums and differences with shifts that are short too are exact in float64, and so is the mean of eight centres.
    """
    cameras = []
    for k in range(4):
        c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[k]
        rotation = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]], np.float64)
        for side in (-1, 1):
            pose = np.eye(4)
            pose[:3, :3] = rotation
            pose[:3, 3] = (0.25 * side, -0.125 * side, 1.375 + 0.125 * k)
            lens = np.array([[64.0, 0, SIZE / 2], [0, 64, SIZE / 2], [0, 0, 1]])
            cameras.append(Camera(f"{k}{'ab'[side > 0]}", lens, pose, SIZE, SIZE))
    return Rig(tuple(cameras))


RIG = dyadic_rig()
