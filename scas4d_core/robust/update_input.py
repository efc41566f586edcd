"""All that the update of one frame starts from: the state, the pictures, and what earlier frames have shown."""

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
"""Frames at the beginning that may stand as nothing is seen to move: what enters is born only in frames that do not."""


@dataclass(frozen=True, eq=False)
class UpdateInput:
    """All that the update of one frame starts from.

    Attributes:
        state: Θ_{t−1}. motion: that was found last, or None. seconds: since then. step: since the frame before.
        views: of the frame, to learn from. suspects: views of cameras that are left out. seed: of the update.
        brightness: mean of each camera's picture. past: the usual figures. carried: arrays of the effects.
        lengths: [N, 3] metres, of the axes in frame 0.
        exposure, left_out, unusable: by the brightness of the pictures, see ``checks.check_brightness``.
        light_moves: whether it goes on from frame to frame, see ``checks.goes_on``.
        may_be_static: whether the pictures have shown nothing to move yet, where they decide which Gaussians move.
        same: cameras whose picture is that of the last frame that was believed. sharp: ``alarms.sharpness`` of each.
        end: moment by which the last iteration has to be over. iteration_seconds: seconds of an iteration in the
            updates before.
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
