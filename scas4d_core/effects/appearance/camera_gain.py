"""Camera gains: a fixed or drifting brightness factor per camera and channel.

A gain is applied to linear light, before the sRGB curve. On the power part of the curve, s = 1.055 L^(1/2.4) − 0.055, a
gain γ multiplies s + 0.055 by a = γ^(1/2.4). Therefore, only one number per channel is estimated: the median over
pixels of (image + 0.055) / (rendering + 0.055). Independent gains and offsets, as in frame 0, would trade off against
each other.

The gains are estimated from the renderings of the update. Each pass over the cameras updates each gain once, by half of
the estimated difference. Later frames start from these gains. When the effect is switched off, the gains keep their
last values.
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
"""Exponent of the sRGB curve. A gain in linear light is the gain of s + 0.055, raised to this power."""
# The thresholds are based on these measured spreads: at most 0.011 on the five objects (on cloth) and 0.002 on stage,
# whose cameras are identical; 0.025 on basketball, whose gains are known from frame 0, and where the effect gains
# 0.03 dB; 0.078 to 0.094 on lamps.


def current_exposures(
    exposures: dict[str, Array], carried: Mapping[str, Arrays], names: tuple[str, ...]
) -> dict[str, Array]:
    """Returns the [3, 2] exposure (gain and offset) of each camera, from the latest gains if there are any.

    Args:
        exposures: exposure of each camera, as estimated in frame 0.
        carried: arrays carried over by the effects, keyed by effect name.
        names: camera names of the rig, in rig order.
    """
    if NAME not in carried:
        return exposures
    return {name: gain_to_exposure(gain) for name, gain in zip(names, carried[NAME]["gains"], strict=True)}


class CameraGains(UpdatePart):
    """Sets the initial gains of an update and stores its final gains for the next one."""

    def __init__(self, builder: PlanBuilder) -> None:
        self._rows = {name: row for row, name in enumerate(builder.factory.rig.names)}

    def begin(self, attempt: Attempt) -> None:
        """Starts from the gains of the previous frame, or from those of frame 0."""
        if NAME in attempt.carried:
            attempt.gains = attempt.carried[NAME]["gains"].copy()
            return
        gains = np.ones((len(self._rows), 3), np.float32)
        for view in attempt.views:
            gains[self._rows[view.name]] = exposure_to_gain(view.exposure)
        attempt.gains = gains / _centre(gains)

    def end(self, attempt: Attempt, state: Gaussians) -> Gaussians:
        """Stores the gains for the next frame."""
        attempt.carried[NAME] = {"gains": attempt.engine.gains()}
        return state


def _centre(gains: Array) -> Array:
    """Returns the [3] geometric mean of gains [C, 3] over the cameras."""
    centre: Array = np.exp(np.log(gains).mean(axis=0))
    return centre


def spread_of(seen: FrameObservation) -> float | None:
    """Returns the standard deviation of colour gains over cameras, or None if too few cameras were measured.

    The gains are in linear light, estimated from the mean colours of images and renderings. The factor that
    all channels of a camera share is removed, because glossy objects on a black background and objects that are
    rendered slightly too small affect all channels equally.
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
    """Estimates a gain per camera and channel from the renderings of an update."""

    def evidence(self, seen: FrameObservation) -> Evidence | None:
        """Returns how much colour gains differ between cameras, including differences that are already corrected."""
        spread = spread_of(seen)
        return (
            None
            if spread is None
            else Evidence(min(1.0, spread), f"colour gains differ by {spread:.1%} between cameras")
        )

    def register(self, builder: PlanBuilder) -> None:
        """Adds the estimation of gains, which requires full images, to the updates."""
        builder.plan.full_images = builder.plan.camera_gains = True
        builder.parts.append(CameraGains(builder))


EFFECT = CameraGain(
    name=NAME,
    group=EffectGroup.APPEARANCE,
    description="Each camera has a gain per channel, which may drift.",
    disambiguation="For each channel, the gains of all cameras multiply to 1; a change that all cameras share is "
    "attributed to lighting and changes the colours.",
    cost="a median over about 4,000 pixels per iteration, 1% of the update time",
    auto=True,
    on_above=0.04,
    off_below=0.02,
    committed_arrays=("gains",),
)
