"""The input of the update of one frame: the state, the images, and the values carried over from earlier frames."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.views import TrainingView
from scas4d_core.gaussians import Gaussians
from scas4d_core.robust.outliers import Past
from scas4d_core.update.parts import Arrays
from scas4d_core.update.warm_start import Motion

RESTING = 10
"""Maximum number of initial frames that may count as static; objects enter only in frames that are not static."""


@dataclass(frozen=True, eq=False)
class UpdateInput:
    """The input of the update of one frame.

    Attributes:
        state: Θ_{t−1}. motion: latest motion, or None. seconds: since the last learnt frame. step: since the previous
            frame.
        views: views of the frame, to learn from. suspects: views of excluded cameras. seed: seed of the update.
        brightness: mean of each camera's image. past: the usual values. carried: arrays of the effects.
        lengths: [N, 3] axis lengths in frame 0, in metres.
        exposure, left_out, unusable: from the image brightness, see ``checks.check_brightness``.
        light_moves: whether the lighting change continues from frame to frame, see ``checks.light_continues``.
        may_be_static: whether the images have shown no motion yet, in scenes that learn labels from motion.
        same: cameras whose image equals that of the last accepted frame. sharp: ``alarms.sharpness`` of each camera.
        left_out: cameras excluded before the update, with the reason.
        end: time by which the last iteration must end. iteration_seconds: seconds per iteration in previous updates.
    """

    state: Gaussians
    motion: Motion | None
    seconds: float
    step: float
    views: list[TrainingView]
    suspects: list[TrainingView]
    brightness: Mapping[str, float]
    seed: int
    past: Past
    lengths: NDArray[np.float32]
    exposure: float = 1.0
    light_moves: bool = False
    may_be_static: bool = False
    same: Collection[str] = ()
    sharp: Mapping[str, float] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)
    unusable: str | None = None
    carried: Mapping[str, Arrays] = field(default_factory=dict)
    end: float | None = None
    iteration_seconds: float | None = None
