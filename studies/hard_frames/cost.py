"""Cost of the checks: their share of the update time according to the stage timers, compared with the target."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from scas4d_core.frame_report import FrameReport
from studies.hard_frames.footage import AnyFootage

TARGET = 0.03
"""Largest fraction of an update's time that the checks may take."""

Share = tuple[float, float, float]


def shares(reports: Sequence[FrameReport]) -> Share:
    """Returns medians over updates: seconds per update, and shares of the checks and of comparing start and end.

    The checks make up the stage ``judge``: exposure of the images, the gate, plausibility, fits, and views of cameras
    that are left out. Start and end are compared on the probe views. This comparison is part of the update and allows
    it to end at any moment.
    """
    totals = [sum(report.seconds.values()) for report in reports]
    checks = [report.seconds["judge"] / total for report, total in zip(reports, totals, strict=True)]
    probes = [
        (report.seconds["start"] + report.seconds["end"]) / total for report, total in zip(reports, totals, strict=True)
    ]
    return float(np.median(totals)), float(np.median(checks)), float(np.median(probes))


def cost(footage: AnyFootage, updates: int = 8) -> Share:
    """Runs updates of some footage and returns their ``shares``, excluding the first update, which is a cold start."""
    with TemporaryDirectory() as folder:
        scene = footage.start(Path(folder) / "states")
        reports = [scene.step(footage.frame(index)) for index in range(1, updates + 2)]
    return shares(reports[1:])


def in_words(footage: AnyFootage, found: Share) -> str:
    """Formats the cost as one line."""
    seconds, checks, probes = found
    verdict = f"{'reached' if checks <= TARGET else 'missed'}: {100 * TARGET:.0f}%"
    return (
        f"{footage.name}: the checks take {100 * checks:.1f}% of an update of {seconds:.2f} s ({verdict}), "
        f"comparing its start and end takes {100 * probes:.1f}%"
    )
