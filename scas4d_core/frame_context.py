"""One frame on its way through ``Reconstruction.step``: what each stage adds, from its pictures to the commit."""

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
    """What the pictures of a frame say before any update.

    Attributes:
        seconds: since the last committed frame. views: of all its cameras.
        bright: by camera, mean of the picture, 0…1. fingerprints: by camera, of the picture.
        exposure: times that the frame is brighter than usual. left_out: cameras whose pictures are not believed, with
            the reason. unusable: why the frame cannot be used, or None (``robust.checks.check_brightness``).
        light_changes: whether the light goes on changing from frame to frame.
        past: usual figures of the scene, with this frame's brightness.
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
        """The views to learn from."""
        return [view for view in self.views if view.name not in self.left_out]

    @property
    def steady(self) -> bool:
        """True where differences of the pictures to those before are motion, and not light."""
        return self.unusable is None and self.exposure == 1.0


@dataclass(eq=False)
class FrameContext:
    """One frame on its way; each stage of ``Reconstruction.step`` fills in what it adds.

    Attributes:
        frame: with its pictures decoded. watch: times the stages. dropped: cameras that the caller has left out, with
            the reason. notes: further facts to commit, as JSON.
        frame_input: by "observe". prepared, update_input: the updater and its input, by "prepare".
        result, past: of the update, by "solve". check_seconds: seconds that checks took beside it.
        birth_fit_time: time for Gaussians that are born, by "populate".
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
