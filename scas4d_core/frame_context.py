"""Data of one frame while ``Reconstruction.step`` processes it; each stage adds its results."""

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
    """Measurements taken from the images of a frame before its update.

    Attributes:
        seconds: time since the last committed frame, in seconds.
        views: views of all cameras that have an image.
        bright: mean brightness of each camera's image, 0…1.
        fingerprints: fingerprint of each camera's image.
        exposure: brightness of the frame relative to the usual brightness.
        left_out: maps each excluded camera to the reason.
        unusable: reason why the frame cannot be used, or None (``robust.checks.check_brightness``).
        light_changes: whether the lighting keeps changing from frame to frame.
        past: statistics of the scene, including the brightness of this frame.
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
        """Views that the update learns from."""
        return [view for view in self.views if view.name not in self.left_out]

    @property
    def steady(self) -> bool:
        """Whether image differences from the previous frame are due to motion rather than lighting."""
        return self.unusable is None and self.exposure == 1.0


@dataclass(eq=False)
class FrameContext:
    """Frame being processed; each stage of ``Reconstruction.step`` fills in its fields.

    Attributes:
        frame: the frame, with decoded images.
        watch: stopwatch that times the stages.
        dropped: maps each camera excluded by the caller to the reason.
        notes: additional JSON data to commit.
        frame_input: measurements of the images, set by the "observe" stage.
        prepared: updater and carry-over, set by the "prepare" stage.
        update_input: input of the updater, set by the "prepare" stage.
        result: result of the update, set by the "solve" stage.
        past: statistics after the update, set by the "solve" stage.
        check_seconds: duration of the checks outside the update, in seconds.
        birth_fit_time: time limit for fitting added Gaussians, used by the "populate" stage.
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
