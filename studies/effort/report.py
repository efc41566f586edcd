"""Cost of an update's report: its share of the update time.

The stage ``report`` covers the stage timers, the cameras' colour shifts, and assembling and writing the record.
Publishing the record, as a worker does, is timed here and added to the stage.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any

import numpy as np

from client.cli.evaluate import Report
from client.cli.scores import Row
from client.importers.open_source import open_source
from scas4d_core.engines.engine import REPORT
from studies.effort.effort import COUNTED_FROM, changed, leave
from studies.quality.first_frame import started
from studies.quality.settings import settings_of

TARGET = 0.02
"""Largest fraction of an update's time that its report may take."""


def measure_report(folder: Path, out: Path, *, updates: int = 12, report: Report = print) -> Row:
    """Runs updates of ``scas4d`` and writes the cost of their reports to ``out/effort/<capture>-report.json``.

    Args:
        folder: capture folder.
        out: folder of a study that contains the states of frame 0.
        updates: number of updates to run on the capture; the first ones are not counted.
        report: callback that prints progress messages.
    """
    capture = open_source(folder)
    settings = changed(settings_of("scas4d"), skip_tolerance=-1.0)
    shares: list[float] = []
    stages: list[dict[str, float]] = []
    with tempfile.TemporaryDirectory() as directory:
        scene = started(capture, settings, out, Path(directory))
        for index in range(1, min(updates, capture.frame_count - 1) + 1):
            done = scene.step(capture.frame(index))
            if index < COUNTED_FROM:
                continue
            seconds = {**done.seconds, REPORT: done.seconds[REPORT] + _published(scene, index)}
            stages.append(seconds)
            shares.append(seconds[REPORT] / sum(seconds.values()))
    answer: Row = {
        "updates": len(shares),
        "share": float(np.median(shares)),
        "share_worst": float(max(shares)),
        "milliseconds": 1000 * float(np.median([one[REPORT] for one in stages])),
        "stages": {name: float(np.median([one.get(name, 0.0) for one in stages])) for name in _names(stages)},
    }
    verdict = "reached" if answer["share"] <= TARGET else "missed"
    report(
        f"    {capture.name}: report: {100 * answer['share']:.2f}% of an update ({verdict}: {100 * TARGET:.0f}%), "
        f"{answer['milliseconds']:.1f} ms"
    )
    return leave(out, f"{capture.name}-report", capture, answer)


def _published(scene: Any, index: int) -> float:
    """Returns the seconds that a worker takes to publish a record: to read it from the commit and pickle it."""
    began = time.perf_counter()
    ForkingPickler.dumps(scene.history.report(index))  # as for a pipe
    return time.perf_counter() - began


def _names(stages: Sequence[dict[str, float]]) -> list[str]:
    return list(dict.fromkeys(name for one in stages for name in one))
