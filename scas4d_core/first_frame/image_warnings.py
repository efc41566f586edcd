"""Warnings about images and masks of frame 0 that do not show a scene, whatever the calibration is.

Black images, or one image for all cameras, look like a wrong calibration to every later step. These
warnings precede those of the later steps, so that users look for the right cause.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

SHARES = (0.1, 99.9)
"""Percentiles of the pixel values that count as the darkest and brightest value. A sensor has a few hot pixels."""
BLACK, WHITE = 16, 250
"""Brightest value, [0, 255], of an image that counts as black, and darkest value of one that counts as white."""
ONE_COLOUR = 8
"""Maximum difference between the darkest and the brightest value of a channel in an image of a single colour."""
STRIDE = 4
"""Row and column stride of the pixels that are examined."""
LISTED = 8
"""Maximum number of camera names in a warning."""


def image_warnings(images: Mapping[str, NDArray[np.uint8]], masks: Mapping[str, NDArray[np.uint8]]) -> list[str]:
    """Returns warnings about images that show nothing, images that are identical, and empty or full masks.

    Args:
        images: maps each camera name to its image, [H, W, 3] uint8.
        masks: maps each camera name to its mask, [H, W], non-zero on the foreground; may be empty.

    >>> scene = np.arange(3072, dtype=np.uint8).reshape(32, 32, 3)
    >>> image_warnings({"a": scene, "b": scene[::-1], "c": 0 * scene}, {})
    ['1 of 3 images is black (c); a covered lens, missing light or the exposure may be the cause']
    >>> image_warnings({"a": scene, "b": scene}, {"a": scene[..., 0] < 0, "b": scene[..., 0] < 0})
    ['all 2 images are identical (a, b); one file may have been used for several cameras', 'all masks are empty; ...']
    """
    kinds: dict[str, list[str]] = {"black": [], "white": [], "of a single colour": []}
    by_content: dict[int, list[str]] = {}
    for name, image in images.items():
        kind = _kind(image)
        if kind is None:
            by_content.setdefault(crc32(np.ascontiguousarray(image).data), []).append(name)
        else:
            kinds[kind].append(name)
    causes = {
        "black": "a covered lens, missing light or the exposure may be the cause",
        "white": "the exposure may be the cause",
        "of a single colour": "the camera may have sent no picture, or see nothing of the scene",
    }
    warnings = [
        f"{_some(names, len(images))} {kind}{_of(names)}; {causes[kind]}" for kind, names in kinds.items() if names
    ]
    warnings += [
        f"{_some(names, len(images))} identical{_of(names)}; one file may have been used for several cameras"
        for names in by_content.values()
        if len(names) > 1
    ]
    if masks and not any(mask.any() for mask in masks.values()):
        warnings.append("all masks are empty; foreground pixels must not be 0")
    if masks and all(mask.all() for mask in masks.values()):
        warnings.append("all masks are full, so that everything counts as foreground; background pixels must be 0")
    return warnings


def _kind(image: NDArray[np.uint8]) -> str | None:
    darkest, brightest = np.percentile(image[::STRIDE, ::STRIDE].reshape(-1, image.shape[-1]), SHARES, axis=0)
    if brightest.max() <= BLACK:
        return "black"
    if darkest.min() >= WHITE:
        return "white"
    return "of a single colour" if (brightest - darkest).max() <= ONE_COLOUR else None


def _some(names: Sequence[str], count: int) -> str:
    if len(names) == count > 1:
        return f"all {count} images are"
    return f"{len(names)} of {count} images {'is' if len(names) == 1 else 'are'}"


def _of(names: Sequence[str]) -> str:
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return f" ({', '.join(names[:LISTED])}{more})"
