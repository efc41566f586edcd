"""Camera gains, and their conversion to exposures.

Suppose that a camera scales the linear light of a channel by a factor γ, before the sRGB curve. On the power segment of
the curve, s = 1.055 L^(1/2.4) − 0.055. There, a value s becomes a s + 0.055 (a − 1), with the gain a = γ^(1/2.4). In
other words, s + 0.055 is multiplied by a. The gain is therefore estimated as the median over pixels of
(image + 0.055) / (rendering + 0.055).
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

FOOT = np.float32(0.055)
"""Offset of the power segment of the sRGB curve; see the module docstring."""
MIDDLE = np.float32(0.5)
"""Pixel value, in [0, 1], for which ``exposure_to_gain`` returns an equivalent gain."""
LOOKED_AT = 4096
"""Approximate number of pixels sampled per image on a regular grid. More pixels would barely change the median."""
DARK, SATURATED = 0.05, 0.985
"""Range of pixel values in [0, 1] used to measure a gain. Darker pixels are noisy and lie on the linear segment."""
PIXELS = 100
"""Minimum number of usable pixels per channel. With fewer, the camera's gain is not updated."""
SHARE = 0.5
"""Fraction of the difference between measured and current gains that is applied per round. An update of 100 iterations
has three to eight rounds, which is enough to follow a drift. A single outlier round has little effect."""
LARGEST = 2.0
"""Maximum gain a. The minimum is its inverse. A gain of 2 corresponds to about 5 times the light."""
CAMERAS = 4
"""Minimum number of measured cameras. With fewer, gains cannot be distinguished from colours that only a few cameras
see."""
ENOUGH = 0.5
"""Minimum fraction of the rig's cameras needed to update the gains. With fewer, local errors would bias the gains."""


def gain_to_exposure(gain: Array) -> Array:
    """Converts per-channel gains [3] to an exposure [3, 2], i.e. a gain and offset for pixel values.

    >>> gain_to_exposure(np.ones(3, np.float32))[0]
    array([1., 0.], dtype=float32)
    """
    return np.stack([gain, FOOT * (gain - 1)], axis=1).astype(np.float32)


def exposure_to_gain(exposure: Array) -> Array:
    """Returns the gain [3] that has the same effect on the value ``MIDDLE`` as an exposure [3 or more, 2]."""
    gain: Array = (exposure[:3, 0] * MIDDLE + exposure[:3, 1] + FOOT) / (MIDDLE + FOOT)
    return gain


def measured_gain(picture: Array, shown: Array) -> Array:
    """Returns the gain [3] of an image [3, H, W] relative to its rendering before exposure.

    A channel with fewer than ``PIXELS`` usable pixels is NaN.
    """
    gain = np.full(3, np.nan, np.float32)
    every = max(1, int(sqrt(picture[0].size / LOOKED_AT)))
    for channel in range(3):
        here, there = picture[channel, ::every, ::every], shown[channel, ::every, ::every]
        usable = (here > DARK) & (here < SATURATED) & (there > DARK) & (there < SATURATED)
        if np.count_nonzero(usable) >= PIXELS:
            gain[channel] = np.median((here[usable] + FOOT) / (there[usable] + FOOT))
    return gain


def update_gains(gains: Array, measured: dict[int, Array], cameras: int) -> Array | None:
    """Returns the updated gains after a round over the cameras, or None if there are too few measurements.

    The logarithm of each gain moves towards its measured value by the fraction ``SHARE`` of the difference. The mean
    logarithm of the gains is preserved, because a change common to all cameras is a change in lighting.

    Args:
        gains: [cameras of the rig, 3] current gains.
        measured: maps rows of ``gains`` to the results of ``measured_gain``.
        cameras: number of cameras that contribute to the frame.
    """
    rows = [row for row, gain in measured.items() if np.isfinite(gain).all()]
    if len(rows) < CAMERAS or cameras < ENOUGH * len(gains):
        return None
    before = np.log(gains[rows])
    way = np.log(np.stack([measured[row] for row in rows])) - before
    way -= way.mean(axis=0)
    after = before + np.float32(SHARE) * way
    settled = gains.copy()
    settled[rows] = np.exp(np.clip(after, -np.log(LARGEST), np.log(LARGEST)))
    return settled
