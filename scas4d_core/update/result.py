"""What comes of an update, and the story of how: seconds by stage, losses, how each camera was met."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from time import perf_counter

from scas4d_core.gaussians import Gaussians
from scas4d_core.update.picture_loss import PictureLoss
from scas4d_core.update.stopping import Pace
from scas4d_core.update.views import TrainingView
from scas4d_core.update.warm_start import Motion

REPORT = "report"
"""The stage of what an update spends on its own report: these timers, losses that nothing but the curve asks for,
colour shifts, and assembling, writing and publishing the record."""


@dataclass
class Stopwatch:
    """Seconds by stage. What the timers take themselves is booked to ``REPORT``."""

    seconds: dict[str, float] = field(default_factory=dict)
    began: float = field(default_factory=perf_counter)
    last: float = field(default_factory=perf_counter)

    @property
    def total(self) -> float:
        """Seconds from the start to the last lap."""
        return self.last - self.began

    def lap(self, stage: str) -> None:
        """Book the time since the last lap to a stage."""
        now = perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self.last
        self.last = perf_counter()
        self.seconds[REPORT] = self.seconds.get(REPORT, 0.0) + self.last - now

    def move(self, stage: str, other: str, seconds: float) -> None:
        """Book a part of a stage to another."""
        self.seconds[stage] -= seconds
        self.seconds[other] = self.seconds.get(other, 0.0) + seconds


@dataclass(frozen=True)
class CameraFit:
    """How well one camera's picture was met, when it was last rendered.

    Attributes:
        psnr: dB. colour_shift: [3] mean of the picture minus mean of the render, RGB in 0…1; None where not measured.
        health: 0…1, 1 where it fits as usual beside the other cameras, 0 where it would be left out (``judge.health``).
    """

    psnr: float
    colour_shift: tuple[float, float, float] | None = None
    health: float = 1.0


@dataclass(frozen=True, eq=False)
class Updated:
    """What an update leaves: Θ_t, the motion that warms the next start, and how it went.

    Attributes:
        losses: each iteration's weighted sum. psnr: dB of each view as it was rendered, in order, as many an iteration
            as the settings say. moments: seconds from the start of the update to the end of each iteration. seconds:
            by stage.
        cameras: how well each camera was met, by name. left_out: cameras that the gate left out, with the reason.
        planned: what the pace planned, see ``pace.Pace.told``.
        errors: image loss by witness view, of the frame before ("still"), the warm start ("warm") and the end ("end");
            empty where nothing was compared. kept: which of them became Θ_t. guards: those that acted, how often.
    """

    gaussians: Gaussians
    motion: Motion
    losses: list[float]
    psnr: list[float]
    seconds: dict[str, float]
    cameras: dict[str, CameraFit] = field(default_factory=dict)
    moments: list[float] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)
    planned: list[tuple[int, int]] = field(default_factory=list)
    errors: dict[str, dict[str, float]] = field(default_factory=dict)
    kept: str = "end"
    guards: dict[str, int] = field(default_factory=dict)

    @classmethod
    def nothing(cls, state: Gaussians, motion: Motion | None) -> Updated:
        """What a frame leaves for which no iteration is run: the state, and the motion, if any, as they were."""
        return cls(state, motion, [], [], {}, kept="still")  # type: ignore[arg-type]


class Story:
    """What happens in an update, iteration by iteration.

    Args:
        cameras: views of the frame. shifts: whether the colour shift of each camera is worked out for the report.

    Attributes:
        losses, psnr, moments, left_out: see ``Updated``. first, last: dB by camera when first and last rendered.
    """

    def __init__(self, cameras: int, shifts: bool = True) -> None:
        self._cameras = cameras
        self._shifts = shifts
        self._complete = False
        self.losses: list[float] = []
        self.psnr: list[float] = []
        self.moments: list[float] = []
        self.first: dict[str, float] = {}
        self.last: dict[str, CameraFit] = {}
        self.left_out: dict[str, str] = {}

    @property
    def iterations(self) -> int:
        """That are over."""
        return len(self.losses)

    def see(self, view: TrainingView, picture: PictureLoss) -> None:
        """A view was rendered and compared."""
        self.psnr.append(picture.psnr)
        self.first.setdefault(view.name, picture.psnr)
        self.last[view.name] = CameraFit(picture.psnr, picture.colour_shift(view) if self._shifts else None)

    def end_iteration(self, loss: float, moment: float) -> bool:
        """An iteration is over; whether it is the one in which the last camera was rendered first."""
        before, self._complete = self._complete, len(self.first) == self._cameras
        self.losses.append(loss)
        self.moments.append(moment)
        return self._complete and not before

    def leave_out(self, found: Mapping[str, str]) -> Mapping[str, str]:
        """The gate's answer, kept and passed on."""
        self.left_out.update(found)
        return found

    def updated(
        self, state: Gaussians, motion: Motion, pace: Pace, errors: dict[str, dict[str, float]], kept: str
    ) -> Updated:
        """The end of it."""
        return Updated(
            state, motion, self.losses, self.psnr, {}, self.last, self.moments, self.left_out, pace.told, errors, kept
        )
