"""Evidence for an effect, and the learnt frame from which it is computed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from scas4d_core.cameras import Rig
    from scas4d_core.engines.renderer import Renderer
    from scas4d_core.engines.views import TrainingView
    from scas4d_core.gaussians import Gaussians
    from scas4d_core.update.result import UpdateResult


@dataclass(frozen=True)
class Evidence:
    """Evidence for an effect, from the frames processed so far.

    Attributes:
        share: strength of the evidence ([0, 1]), compared with the effect's thresholds. For most effects, it is the
            share of the error, pixels or Gaussians that the effect explains or would explain.
        text: human-readable explanation, such as "camera c2 is off by 0.8 pixels".
    """

    share: float
    text: str


@dataclass(eq=False)
class FitTime:
    """Time limit for fitting the Gaussians added in a frame, outside the update, and the time spent on these fits.

    Attributes:
        end: ``perf_counter`` value at which fits must end, or None if there is no limit.
        spent: time spent on fits, in seconds.
        postponed: descriptions of the fits for which there was no time. The next frame detects their objects again.
    """

    end: float | None = None
    spent: float = 0.0
    postponed: list[str] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class FrameObservation:
    """A learnt frame, from which effects compute their evidence and add or retire Gaussians.

    Attributes:
        index: index of the frame.
        before: previous state Θ_{t−1}.
        result: update result, with Θ_t, the trace of the update, and the arrays of the effects.
        rig: cameras in the internal world, with their current poses.
        views: training views used by the update.
        renderer: renderer for states of the scene.
        room: number of Gaussians that may still be added to the scene.
        time: time limit for fitting added Gaussians.
        suspects: views of excluded cameras, which the update did not use.
    """

    index: int
    before: Gaussians
    result: UpdateResult
    rig: Rig
    views: Sequence[TrainingView]
    renderer: Renderer
    room: int = 1_000_000
    time: FitTime = field(default_factory=FitTime)
    suspects: Sequence[TrainingView] = ()
