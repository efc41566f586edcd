"""Silhouettes of an object before a plain background, read off the pictures alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from scas4d_core.first_frame.posed_pictures import Bool, PosedPicture

TOLERANCE = 8
"""Difference from the background, of 255 in any channel, that still counts as background: above resampling and mild
compression noise."""
PLAIN_BORDER = 0.95
"""Share of the border of every picture in one colour from which the background counts as plain."""
SMALL_HOLE = 12
"""Pixels: background islands up to this size inside the object are dark texture, not holes."""


def _border(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.concatenate([image[0], image[-1], image[1:-1, 0], image[1:-1, -1]])


def plain_background(views: Sequence[PosedPicture]) -> NDArray[np.uint8] | None:
    """Colour [3] uint8 that the borders of all pictures share; None where they do not."""
    borders = [_border(view.image) for view in views]
    colour = np.median(np.concatenate(borders), axis=0)
    for border in borders:
        same = np.abs(border - colour).max(axis=1) <= TOLERANCE
        if same.mean() < PLAIN_BORDER:
            return None
    result: NDArray[np.uint8] = colour.astype(np.uint8)
    return result


def silhouette(image: NDArray[np.uint8], background: NDArray[np.uint8]) -> Bool:
    """[H, W] bool, true where the picture differs from the background or is a small island of it within the object."""
    other = np.abs(image.astype(np.int16) - background.astype(np.int16)).max(axis=-1) > TOLERANCE
    islands, count = label(~other)
    sizes = np.bincount(islands.ravel(), minlength=count + 1)
    small = sizes <= SMALL_HOLE
    small[0] = False
    result: Bool = other | small[islands]
    return result


def with_silhouettes(views: Sequence[PosedPicture], background: NDArray[np.uint8]) -> list[PosedPicture]:
    """The views with the silhouette as their mask."""
    return [replace(view, mask=silhouette(view.image, background)) for view in views]
