"""Colours Gaussians by part while preserving the shading of the scene."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.wire import part_colour
from scas4d_core.gaussians import Gaussians

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
"""Luminance weights of RGB according to BT.709."""
DARKEST = 0.35
"""Brightness factor of a part colour for a black Gaussian. The factor for a white Gaussian is 1."""


def part_colours(state: Gaussians, labels: NDArray[Any]) -> NDArray[np.float32]:
    """Returns RGB [N, 3]: the part's colour scaled by the Gaussian's brightness, or grey for a Gaussian without a part.

    Args:
        state: state of N Gaussians.
        labels: [M] part label of each Gaussian, −1 for none. Gaussians beyond the M-th have no part.

    >>> state = Gaussians.of_points([[0, 0, 2], [1, 0, 2]], radius=0.1, colours=1.0)
    >>> part_colours(state, np.array([0])).round(2)
    array([[0.33, 0.65, 0.95],
           [1.  , 1.  , 1.  ]], dtype=float32)
    """
    grey = np.clip(state.colours, 0, 1) @ LUMINANCE
    known = np.full(len(state), -1, np.int64)
    known[: len(labels)] = labels[: len(state)]
    palette = np.array([part_colour(label) for label in range(int(known.max(initial=0)) + 1)], np.float32) / 255
    shaded = palette[np.maximum(known, 0)] * (DARKEST + (1 - DARKEST) * grey[:, None])
    return np.where(known[:, None] >= 0, shaded, grey[:, None]).astype(np.float32)
