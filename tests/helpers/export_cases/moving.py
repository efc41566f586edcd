"""The corner scene in motion: two of its arms turn as rigid parts, the third stands.

The means of an arm lie on a line, so that its turn about itself shows only in the material rotations.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from export_cases import corner
from scas4d_core.gaussians import Gaussians

LABELS = np.array([0, 0, 0, 0, 0, 1, 1, 1, -1, -1])
TURNS = {0: np.array([0.2, -0.5, 0.3]), 1: np.array([-0.4, 0.1, 0.9])}
"""Radians a frame about an axis, by part."""
SHIFTS = {0: np.array([0.05, 0.1, -0.02]), 1: np.array([-0.03, 0.0, 0.08])}
"""Metres a frame."""
RATE = 25.0


def motion(part: int, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotation [3, 3] and shift [3], metres, of a part from the first frame to another."""
    return Rotation.from_rotvec(TURNS[part] * frame).as_matrix(), SHIFTS[part] * frame


def state(frame: int, gloss: bool = False) -> Gaussians:
    """The scene so many frames after the first, exactly rigid."""
    first = corner.state(gloss)
    means, factors = first.means.astype(np.float64), first.factors.astype(np.float64)
    rotations = first.rotations.copy()
    for part in TURNS:
        rows = part == LABELS
        turn, shift = motion(part, frame)
        means[rows] = means[rows] @ turn.T + shift
        factors[rows] = turn @ factors[rows]
        rotations[rows] = np.roll(Rotation.from_matrix(turn).as_quat(), 1)
    label = (LABELS >= 0).astype(np.float32)
    return first.replace(means=np.float32(means), factors=np.float32(factors), rotations=rotations, foreground=label)
