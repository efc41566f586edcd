"""Replays the last frames of a scene, to measure time and error for other numbers of iterations.

Every replay begins with a cold start from the same committed state. The first frame is a warm-up
and does not count. Every later update starts from the previous motion, as in the live scene. The
time budget, the stopping rule and the skipping of updates are disabled, so that every update runs
all iterations. Nothing is written to the files of the scene.
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
"""Function that decodes the images of a frame on each call, and returns the reason for each excluded camera."""


@dataclass(frozen=True)
class ReplayResult:
    """Time and error per frame for a given number of iterations.

    Attributes:
        iterations: number of iterations per frame.
        milliseconds: median time per frame in milliseconds, from decoding to the end of the update.
            The time for writing the state is not included.
        error: mean image loss of the committed states on the probe views, or None if the settings
            disable the comparison of states.
        psnr: mean PSNR in dB of the training views as last rendered, or None if not measured.
        frames: number of measured frames.
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
    """Updates a copy of a scene with a given number of iterations, and measures time and error.

    Args:
        rig: training cameras in the user's world.
        settings: settings of the scene.
        history: history of the scene; only ``base`` and the first frame are read.
        base: index of the committed frame that precedes ``frames``.
        frames: decoders of at least two frames, in order. The first frame is a warm-up.
        iterations: number of iterations per frame.
        over: function called at the end of each update.

    Raises:
        HistoryError: if ``base`` or the first frame cannot be read.
        StepError: if a frame does not follow the previous one.
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
    """Returns the medians and means over the reports of several frames.

    Frames that were degraded or took several attempts are included only if there are no others.
    """
    clean = [report for report in reports if report.degraded is None and len(report.attempts) <= 1] or reports
    errors = [report.errors[report.candidate] for report in clean if report.candidate in report.errors]
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
