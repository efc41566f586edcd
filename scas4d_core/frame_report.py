"""Reports of frames. The report of a frame is committed together with the state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from enum import StrEnum
from itertools import pairwise
from math import isfinite, nan
from time import perf_counter
from typing import Any, TypedDict

import numpy as np

from scas4d_core.captures.frame import Frame
from scas4d_core.captures.images import grey_among
from scas4d_core.engines.engine import REPORT
from scas4d_core.engines.renderer import PairCounts, Renderer, pair_counts
from scas4d_core.engines.views import CameraArrays
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
"""Number of final iterations over which the report averages PSNR: about one pass over the rig's cameras."""
REPORTED_LOSSES = 100
"""Maximum number of losses in the report; the thousands of losses of frame 0 are averaged in groups."""
CHECKPOINTS = 10
"""Maximum number of points on the loss curve of an update."""


class CurvePoint(TypedDict):
    """Point on the loss curve of an update, as stored on disk.

    Keys:
        iterations: number of completed iterations.
        milliseconds: time since the start of the update in milliseconds. The time for decoding the
            images is not included.
        loss: mean training loss since the previous point.
    """

    iterations: int
    milliseconds: float
    loss: float


@dataclass(frozen=True)
class FrameReport:
    """Report of the fit of frame 0, or of the update to a later frame.

    Attributes:
        index: index of the frame.
        time: time of the frame in seconds.
        iterations: number of iterations.
        seconds: duration of each stage in seconds. The stage ``report`` covers compiling this
            report and writing the previous one.
        loss: weighted loss of each iteration. For frame 0, losses are averaged in at most
            ``REPORTED_LOSSES`` groups.
        psnr: mean PSNR in dB over the last ``REPORTED_ITERATIONS`` rendered views, each measured
            when the view was rendered; NaN if not measured.
        moving: number of moving Gaussians.
        gaussians: number of Gaussians that are not retired.
        pairs: number of Gaussians blended into a pixel, or None if the frame was rejected.
        cameras: fit of each camera's image when last rendered. A poor fit may reveal a camera that
            was bumped.
        used: cameras from which the update learnt; empty for a rejected or skipped frame.
        dropped: maps each excluded camera to the reason.
        outcome: outcome of the frame.
        degraded: explanation of a degraded outcome for the user, or None for other outcomes.
        attempts: description and result of each attempt at the frame.
        exposure: brightness of the frame relative to the lighting in which the colours were learnt.
            For a frame without an attempt, the ratio is estimated from the mean image brightness.
            After a lasting change of the lighting, the colours are adapted and the ratio is 1.
        frozen: number of Gaussians that keep their previous state, because their new state is not
            finite, bounded and plausible.
        guards: number of times that each guard acted (``guards.py``), and number of axis lengths
            clamped to their bounds (``axis_bounds``).
        planned: (iteration, total iterations) for each change of the total by the stopping rule or
            by the time limit of frame 0.
        curve: loss curve of the last attempt.
        errors: mean image loss of each candidate on the probe views. The images are divided by the
            ``exposure`` gain before the comparison.
        candidate: candidate that became the state; "previous" if the frame was rejected.
        born: number of Gaussians added in this frame.
        retired: number of Gaussians retired in this frame.
        revived: number of Gaussians revived in this frame.
        postponed: descriptions of work for which the time budget was too short. Later frames do
            some of this work.
        alarms: conditions that need attention (``robust/alarms.py``).
        timing: estimated delay of each camera relative to the other cameras, averaged over this and
            earlier frames. Cameras are included only if motion determines their delay well
            (``robust/timing.py``).
        cloud: origin of the initial points; frame 0 only.
        shortened: descriptions of steps for which ``StaticSettings.seconds`` was too short; frame 0
            only. Small reductions of the iterations appear only in ``planned``.
        calibration: comparison of the calibration with the images; frame 0 only.
        grey: grayscale cameras in a rig that also has colour cameras; frame 0 only.
    """

    index: int
    time: float
    iterations: int
    seconds: dict[str, float]
    loss: list[float]
    psnr: float
    moving: int
    gaussians: int
    pairs: PairCounts | None = None
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
    candidate: Candidate = Candidate.END
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
        """Warnings of this report: those of ``first_warnings`` and ``timing_warnings``."""
        named = {"cloud": self.cloud, "calibration": self.calibration}
        given = {name: asdict(value) for name, value in named.items() if value is not None}
        first = first_warnings({**given, "shortened": self.shortened, "grey": self.grey})
        return [*first, *timing_warnings(self.timing)]

    def record(self) -> dict[str, Any]:
        """Returns the report as JSON data, with None in place of non-finite numbers."""
        record: dict[str, Any] = _json_data(self)
        return record


def _json_data(value: Any) -> Any:
    """Returns a value as JSON data, with None in place of non-finite numbers, which JSON cannot represent."""
    if type(value) is float:  # most values are floats
        return value if isfinite(value) else None
    if is_dataclass(value):
        return {item.name: _json_data(getattr(value, item.name)) for item in fields(value)}
    if isinstance(value, dict):
        return {str(name): _json_data(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_json_data(inner) for inner in value]
    if isinstance(value, StrEnum):
        return value.value
    return None if isinstance(value, float) and not isfinite(value) else value


def report_of_first(
    frame: Frame,
    result: StaticResult,
    names: Sequence[str],
    moving: int,
    renderer: Renderer,
    cameras: Sequence[CameraArrays],
    seconds: dict[str, float],
    dropped: Mapping[str, str] | None,
    calibration: CalibrationReport | None = None,
) -> FrameReport:
    """Returns the report of frame 0.

    Args:
        frame: the first frame.
        result: fit of the first frame.
        names: names of the rig's cameras.
        moving: number of Gaussians in the hierarchy.
        renderer, cameras: see ``report_of_update``.
        seconds: duration of each stage in seconds.
        dropped: maps each camera excluded by the caller to the reason.
        calibration: comparison of the calibration with the images, or None if there was none.
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
        pairs=pair_counts(renderer, result.gaussians, cameras),
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
    renderer: Renderer,
    cameras: Sequence[CameraArrays],
    watch: Stopwatch,
    dropped: Mapping[str, str] | None,
    postponed: Sequence[str] = (),
) -> FrameReport:
    """Returns the report of an update.

    Args:
        frame: frame to which the state was updated.
        result: update result to be committed.
        before: previously committed state.
        left_out: maps each camera excluded by the brightness check to the reason.
        names: names of the rig's cameras.
        renderer: renderer of the scene.
        cameras: cameras in which the Gaussians blended into a pixel are counted.
        watch: stopwatch with the stages "decode", "judge", "update" and optionally "presence".
        dropped: maps each camera excluded by the caller to the reason.
        postponed: descriptions of work for which the time budget was too short.
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
        pairs=None if result.outcome.rejected else pair_counts(renderer, gaussians, cameras),
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
        candidate=trace.kept,
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
    """Returns the mean PSNR in dB of the last ``REPORTED_ITERATIONS`` views, or NaN if empty."""
    return float(np.mean(psnr[-REPORTED_ITERATIONS:])) if psnr else nan


def means(values: list[float], most: int) -> list[float]:
    """Splits the values into at most ``most`` consecutive groups, and returns the group means."""
    return [float(np.mean(part)) for part in np.array_split(values, max(1, min(len(values), most))) if len(part)]


def curve(losses: list[float], moments: list[float]) -> list[CurvePoint]:
    """Returns the loss curve of an update.

    Args:
        losses: loss of each iteration.
        moments: end of each iteration, in seconds since the start of the update.
    """
    ends = np.unique(np.linspace(0, len(moments), CHECKPOINTS + 1).round().astype(int))
    return [
        CurvePoint(iterations=int(end), milliseconds=1000 * moments[end - 1], loss=float(np.mean(losses[begin:end])))
        for begin, end in pairwise(ends)
    ]
