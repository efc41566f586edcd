"""Gains of cameras, and the exposures that they are: one number a channel, applied to light before the sRGB curve.

On the curve's power part, s = 1.055 L^(1/2.4) − 0.055, a gain γ of light makes of a value s the value
a s + 0.055 (a − 1) with a = γ^(1/2.4): s + 0.055 is multiplied by a. So a camera's a is read off its picture: the
median over pixels of (picture + 0.055) / (rendering + 0.055).
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

FOOT = np.float32(0.055)
"""Of the sRGB curve, see above."""
MIDDLE = np.float32(0.5)
"""Value, 0…1, at which a gain and an offset, as frame 0 has them, are taken for one number."""
LOOKED_AT = 4096
"""Pixels of a picture that are looked at, about: rows and columns apart; the median of more is the same."""
DARK, SATURATED = 0.05, 0.985
"""Values, 0…1, between which a pixel measures a gain: darker ones are on the curve's straight part, and noise."""
PIXELS = 100
"""Such pixels, at least; else the camera's gain stays."""
SHARE = 0.5
"""Of the way to what a round over the cameras measures, that the gains take: an update of 100 iterations has three to
eight rounds, so they have followed a drift at its end, and a round that measures something that moved does little."""
LARGEST = 2.0
"""Of a gain's a, and the inverse the smallest: 5 times the light; more is a camera that shows something else."""
CAMERAS = 4
"""Cameras at least, for gains that differ from colours which few cameras see."""
ENOUGH = 0.5
"""Share of the rig's cameras from which a frame teaches gains: between a few, each one's faults pass for gains."""


def gain_to_exposure(gain: Array) -> Array:
    """[3, 2] gain and offset of a picture's values, for the a of each channel [3].

    >>> gain_to_exposure(np.ones(3, np.float32))[0]
    array([1., 0.], dtype=float32)
    """
    return np.stack([gain, FOOT * (gain - 1)], axis=1).astype(np.float32)


def exposure_to_gain(exposure: Array) -> Array:
    """[3] the a that does to the middle value what a gain and an offset [3 or more, 2] do."""
    gain: Array = (exposure[:3, 0] * MIDDLE + exposure[:3, 1] + FOOT) / (MIDDLE + FOOT)
    return gain


def measured_gain(picture: Array, shown: Array) -> Array:
    """[3] the a of each channel of a picture against its rendering without exposure, both [3, H, W]; NaN: unknown."""
    gain = np.full(3, np.nan, np.float32)
    every = max(1, int(sqrt(picture[0].size / LOOKED_AT)))
    for channel in range(3):
        here, there = picture[channel, ::every, ::every], shown[channel, ::every, ::every]
        usable = (here > DARK) & (here < SATURATED) & (there > DARK) & (there < SATURATED)
        if np.count_nonzero(usable) >= PIXELS:
            gain[channel] = np.median((here[usable] + FOOT) / (there[usable] + FOOT))
    return gain


def update_gains(gains: Array, measured: dict[int, Array], cameras: int) -> Array | None:
    """The gains after a round over the cameras; None: the round teaches nothing.

    They take ``SHARE`` of the way. Their mean logarithm stays: what all cameras share is light.

    Args:
        gains: [cameras of the rig, 3]. measured: by row of ``gains``, see ``measured_gain``.
        cameras: number of cameras that take part in the frame.
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
