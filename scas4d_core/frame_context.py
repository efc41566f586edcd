"""Data of one frame while ``Reconstruction.step`` processes the frame. Each stage adds results."""

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
    """Views of a frame, and measurements taken from its images before the update.

    Attributes:
        seconds: time since the last committed frame, in seconds.
        views: views of all cameras that have an image.
        bright: mean brightness of each camera's image, [0, 1].
        fingerprints: checksum of each camera's image (``robust.checks.fingerprints``).
        exposure: brightness of the frame relative to the usual brightness; 1 if the ratio is within
            the usual range.
        left_out: maps each camera excluded by ``robust.checks.check_brightness`` to the reason.
        unusable: reason why nothing can be learnt from the frame, or None.
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
        """Views from which the update learns: those of all cameras that are not excluded."""
        return [view for view in self.views if view.name not in self.left_out]

    @property
    def steady(self) -> bool:
        """Whether changes of the images since the previous frame are motion, not lighting."""
        return self.unusable is None and self.exposure == 1.0


@dataclass(eq=False)
class FrameContext:
    """A frame that is being processed. Each stage of ``Reconstruction.step`` sets some fields.

    Attributes:
        frame: the frame, with decoded images.
        watch: stopwatch that times the stages.
        dropped: maps each camera excluded by the caller to the reason.
        notes: additional JSON data to commit.
        frame_input: views and measurements of the images, set by the "observe" stage.
        prepared: updater and carry-over, set by the "prepare" stage.
        update_input: input of the updater, set by the "prepare" stage.
        result: result of the update, set by the "solve" stage.
        past: statistics after the update, set by the "solve" stage.
        check_seconds: duration of the checks outside the update, in seconds.
        birth_fit_time: time limit for fitting added Gaussians, set by the "populate" stage.
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
