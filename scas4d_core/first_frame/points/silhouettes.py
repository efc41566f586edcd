"""The backdrop colour of a scene and the silhouettes in front of it, from the images only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from scas4d_core.posed_pictures import Bool, PosedPicture

TOLERANCE = 8
"""Difference from the background, in levels of 255 in any channel, that still counts as background: above resampling
and mild compression noise."""
PLAIN_BORDER = 0.95
"""Minimum share of one colour on the border of every image for the background to count as plain."""
SMALL_HOLE = 12
"""Maximum size, in pixels, of background islands inside an object that are dark texture and not holes."""

PLAIN = 0.2
"""Minimum share of all pixels in one colour for a plain backdrop; most cameras must have half of it."""
SAME = 0.05
"""Minimum share of pixels in exactly one colour for a synthetic background. Quantized images of rooms have up to
0.03."""
ALIKE = 8
"""Tolerance, in levels of 255, for pixels of one colour: noise and JPEG artefacts."""
PIXEL_STRIDE = 4
"""Spacing of the sampled pixels."""


def _border(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.concatenate([image[0], image[-1], image[1:-1, 0], image[1:-1, -1]])


def backdrop(images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float64] | None:
    """Returns the colour [3], in levels of 255, of a plain backdrop in many of the images; None if there is none.

    Args:
        images: [H, W, 3] each, larger than ``PIXEL_STRIDE`` pixels on both sides.
    """
    pixels = [_sampled(image) for image in images]
    everyone = np.concatenate(pixels)
    codes, counts = np.unique(everyone @ np.array([1 << 16, 1 << 8, 1]), return_counts=True)
    code = int(codes[counts.argmax()])
    painted = np.array([code >> 16, code >> 8 & 255, code & 255], np.float64)
    if _is_backdrop([_alike(some, painted, 0) for some in pixels], SAME):
        return painted
    cells = np.ravel_multi_index(tuple(everyone.T // ALIKE), (256 // ALIKE,) * 3)
    common: NDArray[np.float64] = np.median(everyone[cells == np.bincount(cells).argmax()], axis=0)
    plain = _is_backdrop([_alike(some, common, ALIKE) for some in pixels], PLAIN)
    return common if plain else None


def mean_colour(images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float64]:
    """Returns the [3] mean colour of all images, in levels of 255."""
    mean: NDArray[np.float64] = np.concatenate([_sampled(image) for image in images]).mean(axis=0)
    return mean


def _sampled(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return image[PIXEL_STRIDE // 2 :: PIXEL_STRIDE, PIXEL_STRIDE // 2 :: PIXEL_STRIDE].reshape(-1, 3)


def _alike(pixels: NDArray[np.uint8], colour: NDArray[np.float64], levels: int) -> Bool:
    return np.asarray((np.abs(pixels - colour) <= levels).all(axis=1))


def _is_backdrop(of_it: list[Bool], share: float) -> bool:
    """Returns true if enough pixels show the backdrop overall, and half that share in most cameras; ``of_it``: by
    camera.
    """
    return bool(np.concatenate(of_it).mean() >= share and np.median([some.mean() for some in of_it]) >= share / 2)


def plain_background(views: Sequence[PosedPicture]) -> NDArray[np.uint8] | None:
    """Returns the colour [3] uint8 that the borders of all images share; None if they differ."""
    borders = [_border(view.image) for view in views]
    colour = np.median(np.concatenate(borders), axis=0)
    for border in borders:
        same = np.abs(border - colour).max(axis=1) <= TOLERANCE
        if same.mean() < PLAIN_BORDER:
            return None
    result: NDArray[np.uint8] = colour.astype(np.uint8)
    return result


def silhouette(image: NDArray[np.uint8], background: NDArray[np.uint8]) -> Bool:
    """Returns [H, W] true for pixels that differ from the background, and for small background islands inside the
    object.
    """
    other = np.abs(image.astype(np.int16) - background.astype(np.int16)).max(axis=-1) > TOLERANCE
    islands, count = label(~other)
    sizes = np.bincount(islands.ravel(), minlength=count + 1)
    small = sizes <= SMALL_HOLE
    small[0] = False
    result: Bool = other | small[islands]
    return result


def with_silhouettes(views: Sequence[PosedPicture], background: NDArray[np.uint8]) -> list[PosedPicture]:
    """Returns the views with silhouettes as their masks."""
    return [replace(view, mask=silhouette(view.image, background)) for view in views]
