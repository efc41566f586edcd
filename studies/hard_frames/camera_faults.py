"""Faults of a single camera's images: blur, noise, gain, white balance and dirt on the lens."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

Picture = NDArray[np.uint8]
"""8-bit image [H, W, 3]."""
FRAMES = 3
"""Number of consecutive faulty frames."""
SMEARED = 0.02
"""Blur caused by dirt on a lens, as a fraction of the image width."""


def blurred(picture: Picture, pixels: float) -> Picture:
    """Blurs an image as if it were out of focus. ``pixels`` is the standard deviation of the blur."""
    picture_blurred: Picture = gaussian_filter(picture.astype(np.float32), (pixels, pixels, 0)).round().astype(np.uint8)
    return picture_blurred


def scaled(picture: Picture, factor: Any) -> Picture:
    """Multiplies an image by one factor, or by one factor per colour channel, saturating at 255."""
    picture_scaled: Picture = (picture * np.asarray(factor)).round().clip(0, 255).astype(np.uint8)
    return picture_scaled


def noisy(picture: Picture, levels: float) -> Picture:
    """Adds noise with a standard deviation given in 8-bit levels, different for each image."""
    rng = np.random.default_rng(int(picture.sum()))
    return (picture + rng.normal(0, levels, picture.shape)).round().clip(0, 255).astype(np.uint8)


def dirty(picture: Picture, white: float) -> Picture:
    """Simulates dirt on the lens: the middle ninth of the image is blurred and brightened by scattered light."""
    height, width = picture.shape[:2]
    middle = slice(height // 3, 2 * height // 3), slice(width // 3, 2 * width // 3)
    smeared = gaussian_filter(picture[middle].astype(np.float32), (SMEARED * width, SMEARED * width, 0))
    smudged = picture.copy()
    smudged[middle] = (smeared + white * (255 - smeared)).round().astype(np.uint8)
    return smudged
