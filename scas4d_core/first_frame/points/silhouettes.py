"""Backdrop colour of a scene, and silhouettes in front of the backdrop, from the images alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from scas4d_core.posed_pictures import Bool, PosedPicture

TOLERANCE = 8
"""Maximum difference of a background pixel from the background colour in any channel, in 8-bit
levels. The noise of resampling and mild compression is smaller."""
PLAIN_BORDER = 0.95
"""Minimum fraction of the border of each image that must have the same colour if the background is
plain."""
SMALL_HOLE = 12
"""Maximum size, in pixels, of background islands inside an object that are treated as texture instead of holes."""

PLAIN = 0.2
"""Minimum fraction of all pixels that must have a similar colour if the backdrop is plain. In most
images, at least half of this fraction must have that colour."""
SAME = 0.05
"""Minimum fraction of all pixels that must have exactly the same colour if the background is
synthetic. In quantized images of rooms, up to 0.03 of the pixels have the same colour."""
ALIKE = 8
"""Maximum difference between similar colours, in 8-bit levels. Noise and JPEG artefacts cause such
differences."""
PIXEL_STRIDE = 4
"""Spacing of the sampled pixels."""


def _border(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.concatenate([image[0], image[-1], image[1:-1, 0], image[1:-1, -1]])


def backdrop(images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float64] | None:
    """Returns the [3] colour of a plain backdrop that many images show, in 8-bit levels, or None if there is none.

    Args:
        images: images [H, W, 3], each side larger than ``PIXEL_STRIDE`` pixels.
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
    """Returns the [3] mean colour of all images, in 8-bit levels."""
    mean: NDArray[np.float64] = np.concatenate([_sampled(image) for image in images]).mean(axis=0)
    return mean


def _sampled(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return image[PIXEL_STRIDE // 2 :: PIXEL_STRIDE, PIXEL_STRIDE // 2 :: PIXEL_STRIDE].reshape(-1, 3)


def _alike(pixels: NDArray[np.uint8], colour: NDArray[np.float64], levels: int) -> Bool:
    return np.asarray((np.abs(pixels - colour) <= levels).all(axis=1))


def _is_backdrop(of_it: list[Bool], share: float) -> bool:
    """Returns whether enough pixels show the backdrop.

    Args:
        of_it: one mask per camera, true for pixels that show the backdrop.
        share: minimum fraction of all pixels. In most images, at least half of this fraction must
            show the backdrop.
    """
    return bool(np.concatenate(of_it).mean() >= share and np.median([some.mean() for some in of_it]) >= share / 2)


def plain_background(views: Sequence[PosedPicture]) -> NDArray[np.uint8] | None:
    """Returns the [3] uint8 colour that the borders of all images share, or None if they differ."""
    borders = [_border(view.image) for view in views]
    colour = np.median(np.concatenate(borders), axis=0)
    for border in borders:
        same = np.abs(border - colour).max(axis=1) <= TOLERANCE
        if same.mean() < PLAIN_BORDER:
            return None
    result: NDArray[np.uint8] = colour.astype(np.uint8)
    return result


def silhouette(image: NDArray[np.uint8], background: NDArray[np.uint8]) -> Bool:
    """Returns the [H, W] mask of pixels that differ from the background, including small islands of background."""
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
