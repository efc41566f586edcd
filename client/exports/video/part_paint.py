"""Colours of Gaussians by their part, for pictures in which the shading still shows."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.wire import part_colour
from scas4d_core.gaussians import Gaussians

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
"""Of BT.709."""
DARKEST = 0.35
"""Brightness of a part where the scene is black; 1 where it is white."""


def part_colours(state: Gaussians, labels: NDArray[Any]) -> NDArray[np.float32]:
    """[N, 3] RGB: the colour of the part, as bright as the Gaussian is; grey where it belongs to none.

    Args:
        labels: [M] part of each Gaussian, −1 for none; those after the M-th belong to none.

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
