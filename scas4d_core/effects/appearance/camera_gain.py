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

import numpy as np
from numpy.typing import NDArray

from scas4d_core.effects.effect import Effect, EffectGroup
from scas4d_core.effects.evidence import Evidence, FrameObservation
from scas4d_core.engines.exposure import CAMERAS, FOOT, exposure_to_gain, gain_to_exposure
from scas4d_core.gaussians import Gaussians
from scas4d_core.update.parts import Array, Arrays, Attempt, PlanBuilder, UpdatePart

NAME = "camera_gain"
POWER = 2.4
"""Of the sRGB curve: a gain of light is the gain of s + 0.055 to this power."""
# Thresholds of the effect: 0.011 at most on the five objects (cloth) and 0.002 on stage, whose cameras are alike; 0.025
# on basketball, whose gains frame 0 knows, and that gains 0.03 dB with these; 0.078 to 0.094 on lamps.


def current_exposures(
    exposures: dict[str, Array], carried: Mapping[str, Arrays], names: tuple[str, ...]
) -> dict[str, Array]:
    """The exposures of the cameras, [3, 2] gain and offset by name: those given, or the gains as they were last.

    Args:
        exposures: that frame 0 found. carried: arrays of the effects. names: of the rig's cameras.
    """
    if NAME not in carried:
        return exposures
    return {name: gain_to_exposure(gain) for name, gain in zip(names, carried[NAME]["gains"], strict=True)}


class CameraGains(UpdatePart):
    """Where the gains of an update start, and what they leave for the next one."""

    def __init__(self, builder: PlanBuilder) -> None:
        self._rows = {name: row for row, name in enumerate(builder.factory.rig.names)}

    def begin(self, attempt: Attempt) -> None:
        """Gains as the frame before left them, or as frame 0 did."""
        if NAME in attempt.carried:
            attempt.gains = attempt.carried[NAME]["gains"].copy()
            return
        gains = np.ones((len(self._rows), 3), np.float32)
        for view in attempt.views:
            gains[self._rows[view.name]] = exposure_to_gain(view.exposure)
        attempt.gains = gains / _centre(gains)

    def end(self, attempt: Attempt, state: Gaussians) -> Gaussians:
        """Leaves the gains for the frame after."""
        attempt.carried[NAME] = {"gains": attempt.engine.gains()}
        return state


def _centre(gains: Array) -> Array:
    """[3] the geometric mean over the cameras [C, 3]."""
    centre: Array = np.exp(np.log(gains).mean(axis=0))
    return centre


def spread_of(seen: FrameObservation) -> float | None:
    """Standard deviation over the cameras of the colour of their gains of light; None: untold.

    It is estimated from means of pictures and renderings. What all channels of a camera share has no say: a thing
    before black that is drawn too small, or that shines a little, is as dark in all of them.
    """
    spreads = []
    for view in seen.views:
        fit = seen.result.trace.cameras.get(view.name)
        if fit is not None and fit["colour_shift"] is not None:
            shown = (view.mean - np.array(fit["colour_shift"]) - view.exposure[:3, 1]) / view.exposure[:3, 0]
            gain = POWER * np.log((view.mean + FOOT) / (np.maximum(shown, 0) + FOOT))
            spreads.append(gain - gain.mean())
    if len(spreads) < CAMERAS:
        return None
    variance: NDArray[np.float64] = np.var(spreads, axis=0)
    return float(np.sqrt(variance.mean()))


@dataclass(frozen=True)
class CameraGain(Effect):
    """A gain for each camera and channel, read off the renderings of an update."""

    def evidence(self, seen: FrameObservation) -> Evidence | None:
        """How much the cameras' gains differ: those that are known, times what their pictures still lack."""
        spread = spread_of(seen)
        return (
            None
            if spread is None
            else Evidence(min(1.0, spread), f"colour gains of the cameras differ by {spread:.1%}")
        )

    def register(self, builder: PlanBuilder) -> None:
        """Adds the gains; they are read off whole pictures."""
        builder.plan.full_images = builder.plan.camera_gains = True
        builder.parts.append(CameraGains(builder))


EFFECT = CameraGain(
    name=NAME,
    group=EffectGroup.APPEARANCE,
    description="Each camera has a gain per channel, which may drift.",
    disambiguation="Per channel the product over the cameras is 1: what all cameras share is light, and goes into "
    "the colours.",
    cost="the median over about 4,000 pixels per iteration, 1 % of an update",
    auto=True,
    on_above=0.04,
    off_below=0.02,
    committed_arrays=("gains",),
)
