"""The data of one frame during ``Reconstruction.step``; each stage adds its results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from scas4d_core.captures.frame import Frame
from scas4d_core.effects.evidence import FitTime
from scas4d_core.engines.views import TrainingView
from scas4d_core.preparation import PreparedUpdate
from scas4d_core.robust.outliers import Past
from scas4d_core.robust.update_input import UpdateInput
from scas4d_core.update.result import Stopwatch, UpdateResult


@dataclass(frozen=True, eq=False)
class FrameInput:
    """The measurements taken from a frame's images before its update.

    Attributes:
        seconds: since the last committed frame. views: views of all cameras that have an image.
        bright: mean brightness of each camera's image, 0…1. fingerprints: fingerprints of each camera's image.
        exposure: brightness of the frame relative to the usual brightness. left_out: excluded cameras, with the reason.
            unusable: why the frame cannot be used, or None (``robust.checks.check_brightness``).
        light_changes: whether the lighting changes from frame to frame.
        past: usual values of the scene, including this frame's brightness.
    """

    seconds: float
    views: list[TrainingView]
    bright: Mapping[str, float]
    fingerprints: Mapping[str, int]
    exposure: float
    left_out: Mapping[str, str]
    unusable: str | None
    light_changes: bool
    past: Past

    @property
    def believed(self) -> list[TrainingView]:
        """The views that the update learns from."""
        return [view for view in self.views if view.name not in self.left_out]

    @property
    def steady(self) -> bool:
        """True if image differences from the previous frame are due to motion and not to lighting."""
        return self.unusable is None and self.exposure == 1.0


@dataclass(eq=False)
class FrameContext:
    """A frame during processing; each stage of ``Reconstruction.step`` fills in its fields.

    Attributes:
        frame: with decoded images. watch: times the stages. dropped: cameras excluded by the caller, with the reason.
            notes: additional data to commit, as JSON.
        frame_input: set by the "observe" stage. prepared, update_input: the updater and its input, set by "prepare".
        result, past: of the update, set by "solve". check_seconds: time of the checks outside the update, in seconds.
        birth_fit_time: time for fitting added Gaussians, spent by "populate".
    """

    frame: Frame
    watch: Stopwatch
    dropped: Mapping[str, str] | None
    notes: Mapping[str, Any]
    frame_input: FrameInput = field(init=False)
    prepared: PreparedUpdate = field(init=False)
    update_input: UpdateInput = field(init=False)
    result: UpdateResult = field(init=False)
    past: Past = field(init=False)
    check_seconds: float = 0.0
    birth_fit_time: FitTime = field(default_factory=FitTime)
