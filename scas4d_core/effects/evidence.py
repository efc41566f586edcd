"""Evidence for an effect, and the committed frame from which it is computed."""

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
    """Evidence for an effect in the frames so far.

    Attributes:
        share: 0…1, what the effect explains or would explain; compared with the thresholds of the effect.
        text: explanation for people, such as "gains of the cameras differ by 8 %".
    """

    share: float
    text: str


@dataclass(eq=False)
class FitTime:
    """The time for fitting the Gaussians added in a frame, outside the update.

    Attributes:
        end: ``perf_counter`` value at which fits must end; None for no limit.
        spent: seconds used by fits. postponed: work that did not fit the time, in words; the next frame detects it
            again.
    """

    end: float | None = None
    spent: float = 0.0
    postponed: list[str] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class FrameObservation:
    """A learnt frame, as input for the evidence of effects.

    Attributes:
        index: index of the frame. before: Θ_{t−1}. result: Θ_t, the trace of its update, arrays of the effects.
        rig: the cameras in the internal world, with their current poses. views: that were learnt from. renderer:
            renders states of the scene.
        room: number of Gaussians that may still be added to the scene. time: for fitting them.
        suspects: views of excluded cameras, which were not learnt from.
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
