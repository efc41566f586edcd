"""Replays the last frames of a scene in memory, to measure the cost and the error of another number of iterations.

Every budget starts from the same committed state, cold. The first frame warms it up and is not counted: after it, each
update starts from a motion, as in the scene. The clock and the stop rule are switched off, so that a budget has its
iterations. Nothing on disk is touched.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from time import perf_counter

import numpy as np

from scas4d_core.cameras import Rig
from scas4d_core.captures.frame import Frame
from scas4d_core.frame_report import FrameReport
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings
from scas4d_core.storage.history import History

Decode = Callable[[], tuple[Frame, Mapping[str, str]]]
"""A frame's pictures, decoded each time anew, and cameras that are left out, with the reason."""


@dataclass(frozen=True)
class ReplayResult:
    """Cost and error of a frame with so many iterations.

    Attributes:
        milliseconds: a frame from decoding to the end of the update, the median; nothing is written.
        error: mean image loss on the probe views of the state that was kept; None where the settings judge nothing.
        psnr: dB, of training views as they were last rendered; None where not measured.
        frames: how many it is measured on.
    """

    iterations: int
    milliseconds: float
    error: float | None
    psnr: float | None
    frames: int


def replay(
    rig: Rig,
    settings: Settings,
    history: History,
    base: int,
    frames: Sequence[Decode],
    iterations: int,
    over: Callable[[], None] = lambda: None,
) -> ReplayResult:
    """Update frames again with another number of iterations.

    Args:
        rig: training cameras, user's world. settings: of the scene.
        history: of the scene; only ``base`` and the first frame are read.
        base: the committed frame that the first of ``frames`` follows.
        frames: at least two, in order; the first warms up. iterations: a frame.
        over: called at the end of each update.

    Raises:
        HistoryError: ``base`` cannot be read.
        StepError: a frame does not follow the one before.
    """
    update = settings.update.model_copy(
        update={"iterations": iterations, "budget_ms": None, "stop_gain": 0.0, "skip_tolerance": -1.0}
    )
    scene = Reconstruction.fork(rig, settings.model_copy(update={"update": update}), history, base)
    reports: list[FrameReport] = []
    for decode in frames:
        began = perf_counter()
        frame, dropped = decode()
        reports.append(scene.step(frame, dropped=dropped, started=began))
        scene.history.retain(last=1)
        over()
    return summary(iterations, reports[1:])


def summary(iterations: int, reports: Sequence[FrameReport]) -> ReplayResult:
    """Frames that were tried more than once or are not met say nothing of the budget: they count where all are so."""
    clean = [report for report in reports if report.degraded is None and len(report.attempts) <= 1] or reports
    errors = [report.errors[report.kept] for report in clean if report.kept in report.errors]
    return ReplayResult(
        iterations,
        1000 * float(np.median([sum(report.seconds.values()) for report in clean])),
        _mean(errors),
        _mean([report.psnr for report in clean]),
        len(clean),
    )


def _mean(values: Sequence[float]) -> float | None:
    known = [value for value in values if isfinite(value)]
    return float(np.mean(known)) if known else None
