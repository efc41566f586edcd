"""Report of frame 0, or of the update of a frame: it is committed beside the state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from itertools import pairwise
from math import isfinite, nan
from time import perf_counter
from typing import Any, TypedDict

import numpy as np

from scas4d_core.captures.frame import Frame
from scas4d_core.captures.images import grey_among
from scas4d_core.engines.engine import REPORT
from scas4d_core.first_frame.calibration.report import CalibrationReport
from scas4d_core.first_frame.static_result import FirstCloud, StaticResult
from scas4d_core.frame_outcome import (
    Alarm,
    CameraTiming,
    Candidate,
    FrameOutcome,
    degraded_text,
    first_warnings,
    timing_warnings,
)
from scas4d_core.gaussians import Gaussians
from scas4d_core.robust.alarms import left_out_alarms
from scas4d_core.update.best_state import mean_error
from scas4d_core.update.result import CameraFit, Stopwatch, UpdateResult

REPORTED_ITERATIONS = 24
"""The report's training loss is a mean over this many last iterations: about one round of a rig's cameras."""
REPORTED_LOSSES = 100
"""Of frame 0's thousands of losses the report keeps so many means at most."""
CHECKPOINTS = 10
"""Points of the curve of an update at most."""


class CurvePoint(TypedDict):
    """A point of an update's curve, as it is on disk.

    Keys:
        iterations: done. milliseconds: since the update began; decoding is before it. loss: mean training loss of the
        iterations since the point before.
    """

    iterations: int
    milliseconds: float
    loss: float


@dataclass(frozen=True)
class FrameReport:
    """Report of frame 0, or of the update of a frame.

    Attributes:
        outcome: of the frame.
        seconds: by stage; ``report`` is what this report costs, and the writing of the one before.
        loss: each iteration's weighted sum; of frame 0 at most ``REPORTED_LOSSES`` means.
        psnr: dB, over the training views of the last iterations, each as it was rendered then; NaN where not measured.
        moving, gaussians: how many Gaussians move, and are there. born, retired, revived: how many were, in this frame.
        postponed: what the budget left no time for, in words; the next frame has some for it.
        alarms: what a person should look at (``robust/alarms.py``).
        timing: by camera, frames after the others at which its pictures seem to be taken, by all frames so far; only
            of cameras for which the motion determines it well enough (``robust/timing.py``).
        cloud: of frame 0: where its first points came from. calibration: of frame 0, against its pictures.
        cameras: by name, how well each camera's picture was met when it was last rendered: a bumped camera shows.
        used: cameras whose pictures were learnt from; none of a rejected or skipped frame. dropped: cameras left
            out, with the reason.
        degraded: for people, why the state is not the frame's, or only in part; None of a frame that went as it should.
        attempts: each attempt at the frame, with what came of it.
        exposure: times that the frame was seen to be brighter than the light in which the colours are; of a frame that
            was not tried, as the mean brightness of its pictures says. A light that stays becomes that of the colours.
        frozen: Gaussians that keep their previous state, one by one. guards: by name, how often each guard acted.
        planned: (iteration, iterations in all) whenever the stopping rule, or the time of frame 0, planned otherwise.
        shortened: of frame 0: what its time (``StaticSettings.seconds``) was too short for, in words; a few iterations
            fewer are in ``planned`` alone. grey: of frame 0: grey cameras, where others have colours.
        curve: of the last attempt.
        errors: mean image loss on the probe views by candidate, in pictures without the gain of ``exposure``.
            kept: the candidate that the state is; "previous" where the frame was held.
    """

    index: int
    time: float
    iterations: int
    seconds: dict[str, float]
    loss: list[float]
    psnr: float
    moving: int
    gaussians: int
    cameras: dict[str, CameraFit] = field(default_factory=dict)
    used: list[str] = field(default_factory=list)
    dropped: dict[str, str] = field(default_factory=dict)
    outcome: FrameOutcome = FrameOutcome.UPDATED
    degraded: str | None = None
    attempts: list[str] = field(default_factory=list)
    exposure: float = 1.0
    frozen: int = 0
    guards: dict[str, int] = field(default_factory=dict)
    planned: list[tuple[int, int]] = field(default_factory=list)
    curve: list[CurvePoint] = field(default_factory=list)
    errors: dict[Candidate, float] = field(default_factory=dict)
    kept: Candidate = Candidate.END
    born: int = 0
    retired: int = 0
    revived: int = 0
    postponed: list[str] = field(default_factory=list)
    alarms: list[Alarm] = field(default_factory=list)
    timing: dict[str, CameraTiming] = field(default_factory=dict)
    cloud: FirstCloud | None = None
    shortened: list[str] = field(default_factory=list)
    calibration: CalibrationReport | None = None
    grey: list[str] = field(default_factory=list)

    @property
    def warnings(self) -> list[str]:
        """Sentences on what looks wrong, or was too much for its time (``first_warnings``, ``timing_warnings``)."""
        named = {"cloud": self.cloud, "calibration": self.calibration}
        given = {name: asdict(value) for name, value in named.items() if value is not None}
        first = first_warnings({**given, "shortened": self.shortened, "grey": self.grey})
        return [*first, *timing_warnings(self.timing)]

    def record(self) -> dict[str, Any]:
        """The report as JSON: numbers that are not finite are None."""
        record: dict[str, Any] = _finite(asdict(self))
        return record


def _finite(value: Any) -> Any:
    """The same, with None for numbers that JSON does not have."""
    if isinstance(value, dict):
        return {str(name): _finite(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    if isinstance(value, StrEnum):
        return value.value
    return None if isinstance(value, float) and not isfinite(value) else value


def report_of_first(
    frame: Frame,
    result: StaticResult,
    names: Sequence[str],
    moving: int,
    seconds: dict[str, float],
    dropped: Mapping[str, str] | None,
    calibration: CalibrationReport | None = None,
) -> FrameReport:
    """The report of frame 0.

    Args:
        names: of the rig's cameras. moving: Gaussians in the hierarchy. seconds: by stage.
        dropped: cameras that the caller has left out, with the reason. calibration: as it was measured.
    """
    return FrameReport(
        index=frame.index,
        time=frame.time,
        iterations=len(result.losses),
        seconds=seconds,
        loss=means(result.losses, REPORTED_LOSSES),
        psnr=_last(result.psnr),
        moving=moving,
        gaussians=len(result.gaussians),
        cameras=result.cameras,
        used=[name for name in names if name in frame.images],
        dropped=dict(dropped or {}),
        alarms=left_out_alarms(names, frame.images, dropped or {}),
        cloud=result.cloud,
        planned=list(result.planned),
        shortened=list(result.shortened),
        grey=grey_among(frame.images),
        calibration=calibration,
    )


def report_of_update(
    frame: Frame,
    result: UpdateResult,
    before: Gaussians,
    left_out: Mapping[str, str],
    names: Sequence[str],
    watch: Stopwatch,
    dropped: Mapping[str, str] | None,
    postponed: Sequence[str] = (),
) -> FrameReport:
    """The report of an update.

    Args:
        result: that is committed. before: the state committed before.
        left_out: cameras whose pictures were not believed at first sight, with the reason.
        names: of the rig's cameras. watch: with the stages "decode", "judge" and "update", and "presence" if it was.
        dropped: cameras that the caller has left out, with the reason. postponed: see ``FrameReport``.
    """
    trace, gaussians = result.trace, result.gaussians
    began = perf_counter()
    missing = {**(dropped or {}), **left_out, **trace.left_out}
    used = [name for name in names if name in frame.images and name not in missing]
    stages = {"decode": watch.seconds["decode"], **trace.seconds}
    stages["judge"] = watch.seconds["judge"] + trace.seconds.get("judge", 0.0)
    stages["other"] = max(0.0, watch.seconds["update"] - sum(trace.seconds.values()))
    if "presence" in watch.seconds:
        stages["presence"] = watch.seconds["presence"]
    report = FrameReport(
        index=frame.index,
        time=frame.time,
        iterations=trace.iterations,
        seconds=stages,
        loss=trace.losses,
        psnr=_last(trace.psnr),
        moving=int(gaussians.moving.sum()),
        gaussians=int(gaussians.present.sum()),
        cameras={
            name: CameraFit(psnr=fit["psnr"], colour_shift=fit["colour_shift"], health=result.health.get(name, 1.0))
            for name, fit in trace.cameras.items()
        },
        used=used if result.outcome.learnt else [],
        dropped=missing,
        outcome=result.outcome,
        degraded=degraded_text(result.outcome, result.reason),
        attempts=list(result.attempts),
        exposure=result.exposure,
        frozen=result.frozen,
        guards={**trace.guards, "axis_bounds": result.bounded},
        planned=trace.planned,
        curve=curve(trace.losses, trace.iteration_ends),
        errors={candidate: mean_error(errors, list(errors)) for candidate, errors in trace.errors.items()},
        kept=trace.kept,
        born=len(gaussians) - len(before),
        retired=int((gaussians.retired[: len(before)] & before.present).sum()),
        revived=int((gaussians.present[: len(before)] & before.retired).sum()),
        postponed=list(postponed),
        alarms=[*left_out_alarms(names, frame.images, missing), *result.alarms],
        timing=dict(result.timing),
    )
    stages[REPORT] = watch.seconds[REPORT] + trace.seconds.get(REPORT, 0.0) + perf_counter() - began
    return report


def _last(psnr: Sequence[float]) -> float:
    """Mean dB of the last views rendered."""
    return float(np.mean(psnr[-REPORTED_ITERATIONS:])) if psnr else nan


def means(values: list[float], most: int) -> list[float]:
    """At most so many means of consecutive values."""
    return [float(np.mean(part)) for part in np.array_split(values, max(1, min(len(values), most))) if len(part)]


def curve(losses: list[float], moments: list[float]) -> list[CurvePoint]:
    """The curve of an update from the loss of each iteration and the seconds at its end."""
    ends = np.unique(np.linspace(0, len(moments), CHECKPOINTS + 1).round().astype(int))
    return [
        CurvePoint(iterations=int(end), milliseconds=1000 * moments[end - 1], loss=float(np.mean(losses[begin:end])))
        for begin, end in pairwise(ends)
    ]
