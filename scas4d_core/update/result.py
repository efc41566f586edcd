"""Options, trace and result of one attempt at an update, and the stopwatch that times its stages."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.engine import REPORT, IterationLog, Thinned
from scas4d_core.engines.views import TrainingView
from scas4d_core.frame_outcome import Alarm, CameraTiming, Candidate, FrameOutcome
from scas4d_core.gaussians import Gaussians
from scas4d_core.update.parts import Arrays
from scas4d_core.update.schedule import Stopping
from scas4d_core.update.warm_start import Motion

Gate = Callable[[Mapping[str, float]], Mapping[str, str]]
"""Judges cameras: takes the first PSNR of each in dB, and returns the cameras to exclude with a reason."""


class Stopwatch:
    """Seconds by stage. What the timers take themselves is booked to ``REPORT``.

    Args:
        began: ``perf_counter`` at the start; None: now.

    Attributes:
        seconds: by stage. began, last: ``perf_counter`` at the start and at the last lap.
    """

    def __init__(self, began: float | None = None) -> None:
        self.seconds: dict[str, float] = {}
        self.began = self.last = perf_counter() if began is None else began

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
class AttemptOptions:
    """Options of one attempt at an update.

    Attributes:
        name: as the report has it.
        rates: factor on all of Adam's rates. rigid: clusters turn and shift, nothing else. freeze_colours: colours
            stay.
        cold: the motion of the update before is not used. iteration_factor: factor on the iterations.
        several_orders: other orders of the views are tried as well, and the best end is taken. layer_rate_factor:
            factor on the rates of
            the layers where no motion leads.
        reference_errors: errors of the updates before at their end, ``best_state.label_by_size``; None: not known.
        stopping: decides how many iterations there are; None: those of the settings.
        gate: called with each camera's first PSNR (dB) once all were rendered; returns the cameras to drop, with the
            reason. None: all stay.
        compare: whether the candidates for Θ_t are compared on the probe views (``best_state``).
        skip_below: image loss by probe view at which Θ_{t−1} needs no iteration; None: there is always one.
        confirm_skip: asked where that is so; true where whole pictures show it, too. None: it is not asked.
        step: seconds since the frame before, where nothing was learnt from that one (``BestState.start``); else None.
    """

    name: str = "as set"
    rates: float = 1.0
    rigid: bool = False
    freeze_colours: bool = False
    cold: bool = False
    iteration_factor: float = 1.0
    several_orders: bool = False
    layer_rate_factor: float = 1.0
    stopping: Stopping | None = None
    gate: Gate | None = None
    compare: bool = False
    skip_below: Mapping[str, float] | None = None
    confirm_skip: Callable[[], bool] | None = None
    reference_errors: Mapping[str, float] | None = None
    step: float | None = None


AS_CONFIGURED = AttemptOptions()
"""The update as the settings have it."""


class CameraFit(TypedDict):
    """The fit of one camera, when it was last rendered; a row of the report, as it is on disk.

    Keys:
        psnr: dB. colour_shift: [3] mean of the picture minus mean of the render, RGB in 0…1; None where not measured.
        health: 0…1, 1 where it fits as usual beside the other cameras, 0 where it would be left out
        (``outliers.health``).
    """

    psnr: float
    colour_shift: tuple[float, float, float] | None
    health: float


def camera_fit(psnr: float, colour_shift: tuple[float, float, float] | None = None) -> CameraFit:
    """The fit of a camera of which nothing is known yet that it could be compared with."""
    return {"psnr": psnr, "colour_shift": colour_shift, "health": 1.0}


@dataclass(eq=False)
class UpdateTrace:
    """Record of one attempt, filled while it runs.

    Attributes:
        losses: each iteration's weighted sum. psnr: dB of each view as it was rendered, in order, as many an iteration
            as the settings say. iteration_ends: seconds from the start of the update to the end of each iteration.
        seconds: by stage.
        first: dB of each camera when first rendered. cameras: how well each was met when last rendered, by name.
        left_out: cameras that the gate left out, with the reason.
        planned: (iteration, iterations in all) whenever the stopping rule planned otherwise.
        errors: image loss by candidate, then by probe view; empty where nothing was compared. kept: the candidate that
            became Θ_t.
        whole: whether these errors are of whole pictures.
        shown: by camera, the renderings of the last ``engine.KEPT_PICTURES`` iterations: evidence is taken from them
            without another rendering. Empty where an update ended sooner than planned.
        guards: those that acted, how often.
    """

    losses: list[float] = field(default_factory=list)
    psnr: list[float] = field(default_factory=list)
    iteration_ends: list[float] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    first: dict[str, float] = field(default_factory=dict)
    cameras: dict[str, CameraFit] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    planned: list[tuple[int, int]] = field(default_factory=list)
    errors: dict[Candidate, dict[str, float]] = field(default_factory=dict)
    kept: Candidate = Candidate.END
    whole: bool = False
    shown: dict[str, Thinned] = field(default_factory=dict)
    guards: dict[str, int] = field(default_factory=dict)

    @property
    def iterations(self) -> int:
        """Iterations that are over."""
        return len(self.losses)

    @property
    def fits(self) -> dict[str, float]:
        """DB by camera, when last rendered."""
        return {name: fit["psnr"] for name, fit in self.cameras.items()}

    @property
    def met(self) -> dict[str, float]:
        """DB of the cameras that were learnt from to the end."""
        return {name: psnr for name, psnr in self.fits.items() if name not in self.left_out}

    def load_log(self, log: IterationLog, views: Sequence[TrainingView]) -> None:
        """Take what an engine has logged so far; colour shifts are evidence for gains of cameras, too."""
        self.losses, self.guards = log.losses, log.guards
        self.psnr = [rendered.psnr for rendered in log.rendered]
        self.first, self.cameras = {}, {}
        for rendered in log.rendered:
            name = views[rendered.view].name
            self.first.setdefault(name, rendered.psnr)
            self.cameras[name] = camera_fit(rendered.psnr, rendered.colour_shift)
        self.shown = {views[view].name: picture for view, picture in log.pictures.items()}


@dataclass(frozen=True, eq=False)
class UpdateResult:
    """The end of an attempt, and of the frame that commits it.

    Attributes:
        gaussians: Θ_t. motion: for the next warm start; None: that starts cold. trace: how it went; of a frame that is
            held, of the last attempt before any search.
        frozen: number of Gaussians that keep their previous state. bounded: number of axes set to the shortest or
            longest permitted length.
        outcome: of the frame. reason: in words, where the outcome is a degraded one.
        attempts: each attempt at the frame, with what came of it.
        exposure: times that the frame is brighter than usual.
        offsets: dB by camera above (+) or below its usual place among the cameras; empty where nothing was rendered.
        health: 0…1 by camera of ``offsets``. alarms: but for the cameras that were left out (``robust/alarms.py``).
        timing: by camera, when its pictures seem to be taken (``robust/timing.py``).
        carried: arrays for the next update, by effect. views: that were learnt from, with the exposures of the end.
        parents: [B] int64 of the Gaussians born in this frame, which are the last rows: the row of the parent that each
            parents in the hierarchy and the graph, or −1 where it starts a structure of its own. None: none is born.
    """

    gaussians: Gaussians
    motion: Motion | None
    trace: UpdateTrace
    frozen: int = 0
    bounded: int = 0
    outcome: FrameOutcome = FrameOutcome.UPDATED
    reason: str = ""
    attempts: Sequence[str] = ()
    exposure: float = 1.0
    offsets: Mapping[str, float] = field(default_factory=dict)
    health: Mapping[str, float] = field(default_factory=dict)
    alarms: Sequence[Alarm] = ()
    timing: Mapping[str, CameraTiming] = field(default_factory=dict)
    carried: Mapping[str, Arrays] = field(default_factory=dict)
    views: Sequence[TrainingView] = ()
    parents: NDArray[np.int64] | None = None

    def with_motion_after(self, first: UpdateResult) -> UpdateResult:
        """An update that went on from where another ended: its motion is that of both."""
        if self.motion is None or first.motion is None:
            return self
        return replace(self, motion=self.motion.after(first.motion))

    def with_errors_of(self, first: UpdateResult) -> UpdateResult:
        """A later attempt with the errors of the frame before and of the warm start as the first one found them."""
        errors: dict[Candidate, dict[str, float]] = {**first.trace.errors}
        errors.pop(Candidate.END, None)
        if self.trace.errors:
            errors[Candidate.END] = self.trace.errors[self.trace.kept]
        shown = self.trace.shown if self.trace.kept is Candidate.END else {}
        return replace(self, trace=replace(self.trace, errors=errors, kept=Candidate.END, shown=shown))
