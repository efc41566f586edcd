"""What was committed with a frame, as the report on the wire."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from client.wire import CameraFitModel, FrameReportModel
from scas4d_core.history import History, HistoryError

KEPT = 512
"""Reports of the newest frames that stay in memory whole; those of older ones are read from disk when asked for."""


def fill(report: FrameReportModel, committed: Mapping[str, Any]) -> None:
    """Puts the numbers of a commit into a frame's report."""
    seconds = {name: float(value) for name, value in committed.get("seconds", {}).items()}
    seconds.setdefault("total", sum(seconds.values()))
    report.seconds = seconds
    report.iterations = committed.get("iterations")
    report.loss = [value for value in committed.get("loss", []) if value is not None]
    report.psnr = committed.get("psnr")
    report.moving = committed.get("moving")
    report.gaussians = committed.get("gaussians")
    report.used_cameras = list(committed.get("used", []))
    report.dropped_cameras = dict(committed.get("dropped", {}))
    report.cameras = {
        name: CameraFitModel(psnr=fit.get("psnr"), colour_shift=fit.get("colour_shift"))
        for name, fit in committed.get("cameras", {}).items()
    }


class ReportFiles:
    """Reads reports from the states of a scene. Blocking, for threads."""

    def __init__(self, states: Path) -> None:
        self._states = states
        self._history: History | None = None
        self._turn = threading.Lock()

    def read(self, index: int) -> dict[str, Any]:
        """What was committed with a frame; empty where its state is deleted or damaged."""
        with self._turn:
            try:
                if self._history is None:
                    self._history = History.load(self._states, only=(index,))
                else:
                    self._history.refresh(only=(index,))
                return self._history.report(index)
            except HistoryError:
                return {}
