"""Cost of an update's report: its share of the update time, and a check that its stage covers the whole cost.

The stage ``report`` covers the stage timers, losses that are computed only for the curve, the cameras' colour shifts,
and assembling and writing the record. Publishing the record, as a worker does, is timed here and added to the stage.
The work that is interleaved with the iterations can be switched off (``FrameUpdate.curve``). Running the same frames
alternately with and without this work measures its total cost independently of the timers.
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
    """Runs updates of ``scas4d`` with and without a full report and writes ``out/effort/<capture>-report.json``.

    Args:
        folder: capture folder.
        out: folder of a study that contains the states of frame 0.
        updates: number of updates to run on the capture; the first ones are not counted.
        report: callback that prints progress messages.
    """
    from scas4d_core.update.frame_update import FrameUpdate

    capture = open_source(folder)
    settings = changed(settings_of("scas4d"), skip_tolerance=-1.0)
    shares: list[float] = []
    stages: list[dict[str, float]] = []
    cpu: dict[bool, list[float]] = {True: [], False: []}
    with tempfile.TemporaryDirectory() as directory:
        scenes = {full: started(capture, settings, out, Path(directory) / str(full)) for full in (True, False)}
        for index in range(1, min(updates, capture.frame_count - 1) + 1):
            frame = capture.frame(index)
            dict(frame.images), dict(frame.masks)  # decoded in advance, so that neither run pays for it
            for full in (True, False) if index % 2 else (False, True):
                began = time.process_time()
                FrameUpdate.curve = full
                try:
                    done = scenes[full].step(frame)
                finally:
                    FrameUpdate.curve = True
                taken = time.process_time() - began
                if index < COUNTED_FROM:
                    continue
                cpu[full].append(taken)
                if full:
                    seconds = {**done.seconds, REPORT: done.seconds[REPORT] + _published(scenes[full], index)}
                    stages.append(seconds)
                    shares.append(seconds[REPORT] / sum(seconds.values()))
    ratios = np.array(cpu[True]) / np.array(cpu[False])
    answer = {
        "updates": len(shares),
        "share": float(np.median(shares)),
        "share_worst": float(max(shares)),
        "milliseconds": 1000 * float(np.median([one[REPORT] for one in stages])),
        "stages": {name: float(np.median([one.get(name, 0.0) for one in stages])) for name in _names(stages)},
        "ratio": float(np.median(ratios)),
        "ratio_quartiles": np.percentile(ratios, (25, 75)).tolist(),
    }
    verdict = "reached" if answer["share"] <= TARGET else "missed"
    low, high = answer["ratio_quartiles"]
    report(
        f"    {capture.name}: report: {100 * answer['share']:.2f}% of an update ({verdict}: {100 * TARGET:.0f}%), "
        f"{answer['milliseconds']:.1f} ms; with the optional work {answer['ratio']:.3f} × the CPU time without it "
        f"(quartiles {low:.3f}, {high:.3f})"
    )
    return leave(out, f"{capture.name}-report", capture, answer)


def _published(scene: Any, index: int) -> float:
    """Returns the seconds that a worker takes to publish a record: to read it from the commit and pickle it."""
    began = time.perf_counter()
    ForkingPickler.dumps(scene.history.report(index))  # as for a pipe
    return time.perf_counter() - began


def _names(stages: Sequence[dict[str, float]]) -> list[str]:
    return list(dict.fromkeys(name for one in stages for name in one))
