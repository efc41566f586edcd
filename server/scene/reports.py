"""What was committed with a frame, as the report on the wire."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from client.wire import Budget, CameraFitModel, CurvePointModel, FrameReportModel, FrameState
from scas4d_core.storage.history import History, HistoryError

KEPT = 512
"""Reports of the newest frames that stay in memory whole; those of older ones are read from disk when asked for."""


def fill(report: FrameReportModel, committed: Mapping[str, Any]) -> None:
    """Puts the numbers of a commit into a frame's report."""
    seconds = {name: float(value) for name, value in committed.get("seconds", {}).items()}
    if "report" in seconds:  # the one before was published after its commit
        seconds["report"] += committed.get("publish_seconds") or 0.0
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
        name: CameraFitModel(psnr=fit.get("psnr"), colour_shift=fit.get("colour_shift"), health=fit.get("health"))
        for name, fit in committed.get("cameras", {}).items()
    }
    report.degraded = committed.get("degraded")
    report.kept = committed.get("kept")
    report.tries = list(committed.get("attempts", []))
    report.exposure = committed.get("exposure")
    report.held_gaussians = committed.get("held")
    report.guards = dict(committed.get("guards", {}))
    report.planned = [(int(first), int(total)) for first, total in committed.get("planned", [])]
    report.curve = [CurvePointModel(**point) for point in committed.get("curve", [])]
    report.errors = dict(committed.get("errors", {}))
    report.threads = committed.get("threads")
    report.remade = bool(committed.get("remade"))
    report.write_seconds = committed.get("write_seconds")
    budget = committed.get("budget")
    report.budget = None if budget is None else Budget.model_validate(budget)


def trouble(report: FrameReportModel) -> str | None:
    """What is wrong with a scene whose newest finished frame is this; None: nothing."""
    if report.state == FrameState.SET_ASIDE:
        return f"frame {report.index} was set aside: {report.error}"
    if report.degraded is not None:
        verb = "" if report.degraded.startswith("held") else "committed in part: "
        return f"frame {report.index} was {verb}{report.degraded}"
    if report.dropped_cameras:
        left_out = "; ".join(f"{name}: {reason}" for name, reason in report.dropped_cameras.items())
        return f"frame {report.index} was committed without camera {left_out}"
    return None


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

    def take_faults(self) -> dict[str, str]:
        """Files that were found damaged or gone since this was asked last, by name with the reason."""
        with self._turn:
            return {} if self._history is None else self._history.take_faults()
