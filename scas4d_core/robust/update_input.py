"""Input to the update of one frame: state, images, and values carried over from earlier frames."""

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
"""Maximum number of initial frames that may count as static. Objects can enter only in frames that do not count as
static."""


@dataclass(frozen=True, eq=False)
class UpdateInput:
    """Input to the update of one frame.

    Attributes:
        state: previous state Θ_{t−1}.
        motion: latest motion, or None for a cold start.
        seconds: time since the last learnt frame, in seconds.
        step: time since the previous frame, in seconds.
        gap: difference between the indices of this and the previous frame; 1 unless frames are missing.
        views: training views used for the update.
        suspects: views of excluded cameras.
        brightness: mean of each camera's image, [0, 1], keyed by camera name.
        seed: seed of the update.
        past: usual values of the scene and its cameras.
        lengths: [N, 3] axis lengths in frame 0, in metres.
        exposure: brightness ratio of the frame; see ``checks.check_brightness``.
        light_moves: whether a lighting change continues from frame to frame; see ``checks.light_continues``.
        may_be_static: whether the images have shown no motion yet, in scenes that learn labels from motion.
        same: names of the cameras whose image equals that of the last accepted frame.
        sharp: sharpness of each camera's image; see ``alarms.sharpness``.
        left_out: maps each camera excluded before the update to the reason.
        unusable: reason why nothing can be learnt from the frame, or None.
        carried: arrays carried over by the effects, keyed by effect name.
        end: ``perf_counter`` value by which the last iteration must end, or None for no limit.
        iteration_seconds: time per iteration in previous updates, in seconds, or None if unknown.
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
    gap: int = 1
    end: float | None = None
    iteration_seconds: float | None = None
