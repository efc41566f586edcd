"""Options, trace and result of one attempt at an update, and a stopwatch for its stages."""

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

Current = Callable[[], tuple[Gaussians, Sequence[TrainingView]]]
"""Function that returns the current state of an attempt, and the views with the current exposures."""
Gate = Callable[[Mapping[str, float], Current], Mapping[str, str]]
"""Function that takes the first PSNR of each camera in dB, and returns the cameras to exclude, with the reasons."""


class Stopwatch:
    """Measures the time spent in each stage. The overhead of the timers counts as ``REPORT``.

    Args:
        began: ``perf_counter`` value at the start, or None for the current time.

    Attributes:
        seconds: time spent in each stage, in seconds.
        began: ``perf_counter`` value at the start.
        last: ``perf_counter`` value at the last lap.
    """

    def __init__(self, began: float | None = None) -> None:
        self.seconds: dict[str, float] = {}
        self.began = self.last = perf_counter() if began is None else began

    @property
    def total(self) -> float:
        """Seconds from the start to the last lap."""
        return self.last - self.began

    def lap(self, stage: str) -> None:
        """Adds the time since the last lap to a stage."""
        now = perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self.last
        self.last = perf_counter()
        self.seconds[REPORT] = self.seconds.get(REPORT, 0.0) + self.last - now

    def move(self, stage: str, other: str, seconds: float) -> None:
        """Moves some seconds from one stage to another."""
        self.seconds[stage] -= seconds
        self.seconds[other] = self.seconds.get(other, 0.0) + seconds


@dataclass(frozen=True)
class AttemptOptions:
    """Options of one attempt at an update.

    Attributes:
        name: name of the attempt in the report.
        rates: factor on all Adam learning rates.
        rigid: whether only cluster rotations and translations are learnt.
        freeze_colours: whether colours are frozen.
        cold: whether to ignore the previous motion.
        iteration_factor: factor on the number of iterations.
        several_orders: whether the attempt is one of several in different view orders, of which the best is used.
        layer_rate_factor: factor on the layers' rates without a previous motion.
        match_patches: whether the attempt may start from patch matches, if the settings allow it.
        stopping: rule that decides the number of iterations, or None for the number in the settings.
        gate: function that selects cameras to exclude, or None to exclude no cameras. Called once all cameras have been
            rendered.
        compare: whether the candidates for Θ_t are compared on the probe views (``best_state``).
        skip_below: maximum image loss of Θ_{t−1} in each probe view for skipping the iterations, or None to never skip
            them.
        confirm_skip: function that returns whether full-size images confirm a skip, or None if no confirmation is
            needed.
        reference_errors: errors at the end of previous updates, named as by ``best_state.label_by_size``, or None if
            unknown.
        step: time since the previous frame in seconds, if nothing was learnt from that frame (``BestState.start``);
            otherwise None.
    """

    name: str = "as set"
    rates: float = 1.0
    rigid: bool = False
    freeze_colours: bool = False
    cold: bool = False
    iteration_factor: float = 1.0
    several_orders: bool = False
    layer_rate_factor: float = 1.0
    match_patches: bool = True
    stopping: Stopping | None = None
    gate: Gate | None = None
    compare: bool = False
    skip_below: Mapping[str, float] | None = None
    confirm_skip: Callable[[], bool] | None = None
    reference_errors: Mapping[str, float] | None = None
    step: float | None = None


AS_CONFIGURED = AttemptOptions()
"""The update as configured by the settings."""


class CameraFit(TypedDict):
    """The fit of one camera when it was last rendered, stored as a row of the report.

    Keys:
        psnr: PSNR in dB.
        colour_shift: [3] mean of the image minus mean of the rendering, RGB in [0, 1], or None if not measured.
        health: 1 if the camera fits as usual relative to the other cameras, 0 at the exclusion limit
            (``outliers.health``).
    """

    psnr: float
    colour_shift: tuple[float, float, float] | None
    health: float


def camera_fit(psnr: float, colour_shift: tuple[float, float, float] | None = None) -> CameraFit:
    """Returns the fit of a camera that has no usual level to compare with, so its health is 1."""
    return {"psnr": psnr, "colour_shift": colour_shift, "health": 1.0}


@dataclass(eq=False)
class UpdateTrace:
    """Record of one attempt, filled in while the attempt runs.

    Attributes:
        losses: weighted loss of each iteration.
        psnr: PSNR of each rendered view in dB, in order; one or more per iteration, depending on the settings.
        iteration_ends: time from the start of the update to the end of each iteration, in seconds.
        seconds: time spent in each stage, in seconds.
        first: PSNR of each camera when first rendered, in dB.
        cameras: fit of each camera when last rendered.
        left_out: maps each camera excluded by the gate to the reason.
        planned: (iteration, total iterations) for each change of plan by the stopping rule.
        errors: image loss of each candidate in each probe view; empty if nothing was compared.
        kept: candidate that became Θ_t.
        whole: whether ``errors`` are for full-size images.
        shown: rendering of each camera in the last ``engine.KEPT_PICTURES`` iterations, from which evidence is computed
            without rendering again. Empty if the update ended earlier than planned.
        guards: number of interventions by each guard that intervened.
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
        """Number of completed iterations."""
        return len(self.losses)

    @property
    def fits(self) -> dict[str, float]:
        """PSNR of each camera when last rendered, in dB."""
        return {name: fit["psnr"] for name, fit in self.cameras.items()}

    @property
    def met(self) -> dict[str, float]:
        """PSNR of each camera that was not excluded, when last rendered, in dB."""
        return {name: psnr for name, psnr in self.fits.items() if name not in self.left_out}

    def load_log(self, log: IterationLog, views: Sequence[TrainingView]) -> None:
        """Copies the losses, fits, renderings and guards from a log of the engine.

        Args:
            log: log of the attempt.
            views: training views, in the order in which the engine loaded them.
        """
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
    """The result of an attempt, and of the frame that commits it.

    Attributes:
        gaussians: new state Θ_t.
        motion: motion for the next warm start, or None for a cold start.
        trace: trace of the attempt; for a rejected frame, the trace of the last attempt before any search.
        frozen: number of Gaussians that keep their previous state.
        bounded: number of axes clamped to their minimum or maximum length.
        outcome: outcome of the frame.
        reason: human-readable reason for a degraded outcome.
        attempts: description of each attempt at the frame, with its result.
        exposure: brightness ratio of the frame to the usual brightness.
        offsets: offset of each camera above (+) or below its usual level among the cameras, in dB; empty if nothing was
            rendered.
        health: health of each camera in ``offsets``, [0, 1].
        alarms: alarms of the frame, except those of excluded cameras (``robust/alarms.py``).
        timing: relative capture time of each camera (``robust/timing.py``).
        carried: arrays for the next update, keyed by effect name.
        views: training views that were used, with their final exposures.
        parents: [B] int64 row of the parent of each Gaussian added in this frame, whose clusters and neighbours it
            joins; −1 if it starts a new structure. The added Gaussians are the last rows. None if none were added.
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
        """Returns the result of an update that continued ``first``, with both motions combined."""
        if self.motion is None or first.motion is None:
            return self
        return replace(self, motion=self.motion.after(first.motion))

    def with_errors_of(self, first: UpdateResult) -> UpdateResult:
        """Returns the result of a later attempt, with the errors of the other candidates taken from ``first``."""
        errors: dict[Candidate, dict[str, float]] = {**first.trace.errors}
        errors.pop(Candidate.END, None)
        if self.trace.errors:
            errors[Candidate.END] = self.trace.errors[self.trace.kept]
        shown = self.trace.shown if self.trace.kept is Candidate.END else {}
        return replace(self, trace=replace(self.trace, errors=errors, kept=Candidate.END, shown=shown))
