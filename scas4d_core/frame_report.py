"""How frame 0, or the update of a frame, went: what is committed beside its state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from math import isfinite, nan
from time import perf_counter
from typing import Any

import numpy as np

from scas4d_core.captures.frame import Frame
from scas4d_core.first_frame.static_scene import StaticResult
from scas4d_core.robust import outliers as judge
from scas4d_core.robust.solve_frame import Outcome
from scas4d_core.update.probe_views import mean_error
from scas4d_core.update.result import REPORT, CameraFit, Stopwatch

REPORTED_ITERATIONS = 24
"""The report's training loss is a mean over this many last iterations: about one round of a rig's cameras."""
REPORTED_LOSSES = 100
"""Of frame 0's thousands of losses the report keeps so many means at most."""
CHECKPOINTS = 10
"""Points of the curve of an update at most."""


@dataclass(frozen=True)
class Progress:
    """How far a long task is."""

    stage: str
    done: int
    total: int
    detail: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class CurvePoint:
    """How far an update was: mean training loss of the iterations since the point before.

    Attributes:
        milliseconds: since the update began; decoding is before it.
    """

    iterations: int
    milliseconds: float
    loss: float


@dataclass(frozen=True)
class FrameReport:
    """How frame 0, or the update of a frame, went.

    Attributes:
        seconds: by stage; ``report`` is what this report costs, and the writing of the one before.
        loss: each iteration's weighted sum; of frame 0 at most ``REPORTED_LOSSES`` means.
        psnr: dB, over the training views of the last iterations, each as it was rendered then; NaN where not measured.
        moving, gaussians: how many Gaussians move, and are.
        cameras: by name, how well each camera's picture was met when it was last rendered: a bumped camera shows.
        used: cameras whose pictures were learnt from; none of a frame that was held or stood. dropped: cameras left
            out, with the reason.
        degraded: why the state is not the frame's, or only by half; None for a frame that went as it should.
        attempts: how often and in which manner the update was tried, with what came of each.
        exposure: times that the frame was seen to be brighter than the light in which the colours are; of a frame that
            was not tried, as the mean brightness of its pictures says. A light that stays becomes that of the colours.
        held: Gaussians held one by one as they were before. guards: by name, how often each guard acted.
        planned: (iteration, iterations in all) whenever the pace planned otherwise. curve: of the last attempt.
        errors: mean image loss of the witnesses for the frame before ("still"), going on as before ("warm"), and the
            end of the update ("end"), in pictures without what ``exposure`` says. kept: which of them the state is;
            "still" where the frame was held.
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
    degraded: str | None = None
    attempts: list[str] = field(default_factory=list)
    exposure: float = 1.0
    held: int = 0
    guards: dict[str, int] = field(default_factory=dict)
    planned: list[tuple[int, int]] = field(default_factory=list)
    curve: list[CurvePoint] = field(default_factory=list)
    errors: dict[str, float] = field(default_factory=dict)
    kept: str = "end"

    def record(self) -> dict[str, Any]:
        """The report as JSON: what is not finite is None."""
        record: dict[str, Any] = _finite(asdict(self))
        return record


def _finite(value: Any) -> Any:
    """The same, with None for numbers that JSON does not have."""
    if isinstance(value, dict):
        return {name: _finite(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, float) and not isfinite(value) else value


def report_of_first(
    frame: Frame,
    result: StaticResult,
    names: Sequence[str],
    moving: int,
    seconds: dict[str, float],
    dropped: Mapping[str, str] | None,
) -> FrameReport:
    """The report of frame 0.

    Args:
        names: of the rig's cameras. moving: Gaussians in the hierarchy. seconds: by stage.
        dropped: cameras that the caller has left out, with the reason.
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
    )


def report_of_update(
    frame: Frame,
    outcome: Outcome,
    look: judge.Look,
    names: Sequence[str],
    watch: Stopwatch,
    dropped: Mapping[str, str] | None,
) -> FrameReport:
    """The report of an update.

    Args:
        outcome: what is committed. look: what the frame's pictures said. names: of the rig's cameras.
        watch: with the stages "decode", "judge" and "update".
        dropped: cameras that the caller has left out, with the reason.
    """
    updated, gaussians = outcome.updated, outcome.gaussians
    began = perf_counter()
    left_out = {**(dropped or {}), **look.left_out, **updated.left_out}
    learnt = outcome.fresh and not outcome.stood
    stages = {"decode": watch.seconds["decode"], **updated.seconds}
    stages["judge"] = watch.seconds["judge"] + updated.seconds.get("judge", 0.0)
    stages["other"] = max(0.0, watch.seconds["update"] - sum(updated.seconds.values()))
    report = FrameReport(
        index=frame.index,
        time=frame.time,
        iterations=len(updated.losses),
        seconds=stages,
        loss=updated.losses,
        psnr=_last(updated.psnr),
        moving=int(gaussians.moving.sum()),
        gaussians=len(gaussians),
        cameras={
            name: replace(fit, health=judge.health(outcome.fits.get(name))) for name, fit in updated.cameras.items()
        },
        used=[name for name in names if name in frame.images and name not in left_out] if learnt else [],
        dropped=left_out,
        degraded=outcome.degraded,
        attempts=outcome.attempts,
        exposure=outcome.exposure,
        held=outcome.held,
        guards={**updated.guards, "axis_bounds": outcome.bounded},
        planned=updated.planned,
        curve=curve(updated.losses, updated.moments),
        errors={kind: mean_error(errors, list(errors)) for kind, errors in updated.errors.items()},
        kept=updated.kept,
    )
    stages[REPORT] = watch.seconds[REPORT] + updated.seconds.get(REPORT, 0.0) + perf_counter() - began
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
        CurvePoint(int(end), 1000 * moments[end - 1], float(np.mean(losses[begin:end])))
        for begin, end in pairwise(ends)
    ]
