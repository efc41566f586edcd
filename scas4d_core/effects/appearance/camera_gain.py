"""Gains of cameras: each camera and channel shows the scene so many times as bright, fixed or drifting.

A gain is applied to light before the sRGB curve. On the curve's power part, s = 1.055 L^(1/2.4) − 0.055, a gain γ makes
of a value s the value a s + 0.055 (a − 1) with a = γ^(1/2.4): s + 0.055 is multiplied by a. So one number a channel is
learnt, and it is read off the pictures: the median over pixels of (picture + 0.055) / (rendering + 0.055). Where the
gains are learnt as free gains and offsets, as in frame 0, the two make up for each other.

Renderings are those of the update: each round over the cameras gives each gain once, and the gains take half of the
way. Later frames start from them. Once the effect is off, they stay as they were last.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scas4d_core.effects.effect import Effect, Group, refused_on_gpu
from scas4d_core.effects.evidence import Evidence, Seen
from scas4d_core.effects.parts import Array, Arrays, Part, PartsBuilder, Work
from scas4d_core.gaussians import Gaussians

if TYPE_CHECKING:
    from scas4d_core.rasterize.cpu import Gradients
    from scas4d_core.settings import Settings
    from scas4d_core.update.picture_loss import PictureLoss
    from scas4d_core.update.training_view import TrainingView

NAME = "camera_gain"
FOOT = np.float32(0.055)
"""Of the sRGB curve, see above."""
POWER = 2.4
"""Of the sRGB curve: a gain of light is the gain of s + 0.055 to this power."""
LOOKED_AT = 4096
"""Pixels of a picture that are looked at, about: rows and columns apart; the median of more is the same."""
DARK, SATURATED = 0.05, 0.985
"""Values, 0…1, between which a pixel tells a gain: darker ones are on the curve's straight part, and noise."""
PIXELS = 100
"""That tell, at least; else the camera's gain stays."""
SHARE = 0.5
"""Of the way to what a round over the cameras finds, that the gains take: an update of 100 iterations has three to
eight rounds, so that they have followed a drift at its end, and a round that finds a thing moved does little."""
MIDDLE = np.float32(0.5)
"""Value, 0…1, at which a gain and an offset, as frame 0 has them, are taken for one number."""
LARGEST = 2.0
"""Of a gain's a, and the inverse the smallest: 5 times the light, more is a camera that shows something else."""
# Thresholds of the effect: 0.011 at most on the five objects (cloth) and 0.002 on stage, whose cameras are alike; 0.025
# on basketball, whose gains frame 0 knows, and that gains 0.03 dB with these; 0.078 to 0.094 on lamps.
CAMERAS = 4
"""At least, of which the gains can be told from colours that a few cameras see."""
ENOUGH = 0.5
"""Share of the rig's cameras from which a frame teaches gains: between a few, each one's faults pass for gains."""


def known_gains(exposures: dict[str, Array], carried: Mapping[str, Arrays], names: tuple[str, ...]) -> dict[str, Array]:
    """The exposures of the cameras, [3, 2] gain and offset by name: those given, or the gains as they were last.

    Args:
        exposures: that frame 0 found. carried: arrays of the effects. names: of the rig's cameras.
    """
    if NAME not in carried:
        return exposures
    return {name: exposure_of(gain) for name, gain in zip(names, carried[NAME]["gains"], strict=True)}


def exposure_of(gain: Array) -> Array:
    """[3, 2] gain and offset of a picture's values, for the a of each channel [3]."""
    return np.stack([gain, FOOT * (gain - 1)], axis=1).astype(np.float32)


def gain_of(exposure: Array) -> Array:
    """[3] the a that does to the middle value what a gain and an offset [3 or more, 2] do."""
    gain: Array = (exposure[:3, 0] * MIDDLE + exposure[:3, 1] + FOOT) / (MIDDLE + FOOT)
    return gain


def measured(picture: Array, shown: Array) -> Array:
    """[3] the a of each channel of a picture against what is rendered without any, both [3, H, W]; NaN where untold."""
    found = np.full(3, np.nan, np.float32)
    every = max(1, int(sqrt(picture[0].size / LOOKED_AT)))
    for channel in range(3):
        here, there = picture[channel, ::every, ::every], shown[channel, ::every, ::every]
        tells = (here > DARK) & (here < SATURATED) & (there > DARK) & (there < SATURATED)
        if np.count_nonzero(tells) >= PIXELS:
            found[channel] = np.median((here[tells] + FOOT) / (there[tells] + FOOT))
    return found


class CameraGains(Part):
    """The gains in the updates of a scene: an update's views have them as their exposure."""

    def __init__(self, builder: PartsBuilder) -> None:
        self._rows = {name: row for row, name in enumerate(builder.factory.rig.names)}
        self._gains: Array
        self._found: dict[int, Array]

    def start(self, work: Work) -> None:
        """Gains as the frame before left them, or as frame 0 did."""
        self._found = {}
        if NAME in work.carried:
            self._gains = work.carried[NAME]["gains"].copy()
        else:
            self._gains = np.ones((len(self._rows), 3), np.float32)
            for view in work.views:
                self._gains[self._rows[view.name]] = gain_of(view.exposure)
            self._gains /= _centre(self._gains)
        self._set(work)

    def saw(self, work: Work, view: TrainingView, picture: PictureLoss, gradients: Gradients) -> None:
        """Reads a camera's gain off its rendering; after a round over the cameras the gains take it on."""
        row, (_, height, width) = self._rows[view.name], view.target.shape
        if row in self._found:
            self._settle(work)
        self._found[row] = measured(view.target, picture.rasterizer.planes[:3, :height, :width])

    def end(self, work: Work, state: Gaussians) -> Gaussians:
        """Leaves the gains for the frame after."""
        self._settle(work)
        work.carried[NAME] = {"gains": self._gains}
        return state

    def _settle(self, work: Work) -> None:
        """Gains take a part of the way; the mean logarithm of those that were found is what it was: that is light."""
        rows = [row for row, found in self._found.items() if np.isfinite(found).all()]
        if len(rows) >= CAMERAS and len(work.views) >= ENOUGH * len(self._rows):
            before = np.log(self._gains[rows])
            way = np.log(np.stack([self._found[row] for row in rows])) - before
            way -= way.mean(axis=0)
            after = before + np.float32(SHARE) * way
            self._gains[rows] = np.exp(np.clip(after, -np.log(LARGEST), np.log(LARGEST)))
            self._set(work)
        self._found = {}

    def _set(self, work: Work) -> None:
        for view in work.views:
            view.exposure[:3] = exposure_of(self._gains[self._rows[view.name]])


def _centre(gains: Array) -> Array:
    """[3] the geometric mean over the cameras [C, 3]."""
    centre: Array = np.exp(np.log(gains).mean(axis=0))
    return centre


def spread_of(seen: Seen) -> float | None:
    """Standard deviation over the cameras of the colour of their gains of light; None: untold.

    Means of the pictures and of their renderings tell it. What all channels of a camera share has no say: a thing
    before black that is drawn too small, or that shines a little, is as dark in all of them.
    """
    found = []
    for view in seen.views:
        fit = seen.result.trace.cameras.get(view.name)
        if fit is not None and fit["colour_shift"] is not None:
            shown = (view.mean - np.array(fit["colour_shift"]) - view.exposure[:3, 1]) / view.exposure[:3, 0]
            gain = POWER * np.log((view.mean + FOOT) / (np.maximum(shown, 0) + FOOT))
            found.append(gain - gain.mean())
    if len(found) < CAMERAS:
        return None
    variance: NDArray[np.float64] = np.var(found, axis=0)
    return float(np.sqrt(variance.mean()))


@dataclass(frozen=True)
class CameraGain(Effect):
    """A gain for each camera and channel, read off the renderings of an update."""

    def refused(self, settings: Settings) -> tuple[str, str] | None:
        """Refused where another device renders: the gains are read off the CPU's renderings."""
        return refused_on_gpu(settings)

    def evidence(self, seen: Seen) -> Evidence | None:
        """How much the cameras' gains differ: those that are known, times what their pictures still lack."""
        spread = spread_of(seen)
        return (
            None
            if spread is None
            else Evidence(min(1.0, spread), f"colour gains of the cameras differ by {spread:.1%}")
        )

    def join(self, builder: PartsBuilder) -> None:
        """Adds the gains; they are read off whole pictures."""
        builder.whole = builder.exposes = True
        builder.parts.append(CameraGains(builder))


EFFECT = CameraGain(
    name=NAME,
    group=Group.APPEARANCE,
    says="Each camera has a gain for each channel, which may drift.",
    gauge="Per channel the product over the cameras is 1: what all cameras share is light, and goes into the colours.",
    cost="the median over some 4,000 pixels an iteration, 1 % of an update",
    auto=True,
    on_above=0.04,
    off_below=0.02,
    kept=("gains",),
)
