"""Evidence for an effect, and the committed frame that it is taken from."""

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
        text: for people, as "gains of the cameras differ by 8 %".
    """

    share: float
    text: str


@dataclass(eq=False)
class FitTime:
    """The time for fitting what is born in a frame, beside its update.

    Attributes:
        end: ``perf_counter`` by which fits have to be over; None: there is no limit.
        spent: seconds that they took. postponed: what there was no time for, in words; it is found again in the next
            frame.
    """

    end: float | None = None
    spent: float = 0.0
    postponed: list[str] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class FrameObservation:
    """A frame as the evidence for effects is taken from it, once its state is committed.

    Attributes:
        index: of the frame. before: Θ_{t−1}. result: Θ_t, the trace of its update, arrays of the effects.
        rig: the cameras inside, as they were posed. views: that were learnt from. renderer: draws states of the scene.
        room: Gaussians that may still be born in the scene. time: for fitting them.
        suspects: views that were not learnt from, of excluded cameras.
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
