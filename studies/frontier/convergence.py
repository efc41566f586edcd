"""Convergence of an update: PSNR of the test cameras after some of its iterations.

Learning rates and layer starts depend on the fraction of completed iterations. The curve of a long update therefore
does not pass through the end points of shorter updates. The update itself never uses the test cameras.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from client.cli.evaluate import Report
from client.cli.scores import Row, read_row, write_row
from scas4d_core import metrics
from scas4d_core.captures import Capture
from scas4d_core.engines.engine import StepScalars, UpdateEngine
from scas4d_core.gaussians import Gaussians
from scas4d_core.settings import Settings
from scas4d_core.warm_up import compile_in_processes
from studies.captures import open_measured
from studies.frontier.frontier import Variant
from studies.machine import core_version
from studies.quality.first_frame import started

CHECKPOINTS = (0, 1, 2, 4, 7, 10, 15, 20, 25, 30, 40, 50, 60, 70, 80, 90, 100, 125, 150, 175, 200, 225, 250, 275)
"""Iterations after which the state is evaluated, if the update has that many. The last state is always evaluated."""
WATCHED = (("scas4d", 25), ("scas4d", 100), ("scas4d", 300), ("dynamic3dgs", 100), ("dynamic3dgs", 300))
"""Preset and number of iterations of the settings that are measured by default."""

Look = Callable[[int, UpdateEngine], None]
"""Callback that receives the number of completed iterations and the engine in that state."""


class WatchedEngine:
    """Wraps the engine of an update and calls an observer before each iteration."""

    def __init__(self, inner: UpdateEngine, look: Look) -> None:
        self.inner, self._look = inner, look
        self._done = 0

    def iterate(self, views: Sequence[int], step: StepScalars) -> None:
        """Calls the observer, then runs the iteration; see ``UpdateEngine.iterate``."""
        self._look(self._done, self.inner)
        self._done += 1
        self.inner.iterate(views, step)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)


def measure_convergence(
    folder: Path, out: Path, *, updates: int = 5, variants: Sequence[Variant] = (), report: Report = print
) -> Row:
    """Records how a capture's first updates converge and writes the curves to ``out/convergence/<capture>.json``.

    Args:
        folder: capture folder with test cameras.
        out: study folder, which contains the states of frame 0.
        updates: number of updates over which the curves are averaged.
        variants: settings to measure; ``WATCHED`` if empty.
        report: callback that prints progress messages.
    """
    compile_in_processes()
    capture = open_measured(folder)
    updates = min(updates, capture.frame_count - 1)
    curves = []
    for variant in variants or [Variant(f"{name} {count}", name, count) for name, count in WATCHED]:
        each = _watched(capture, variant, out, updates)
        points = sorted(each[0])
        curves.append(
            {
                "label": variant.label,
                "preset": variant.preset,
                "iterations": points,
                "psnr": [float(np.mean([curve[point] for curve in each])) for point in points],
            }
        )
        report(f"    {capture.name}, {variant.label}: {curves[-1]['psnr'][0]:.2f} to {curves[-1]['psnr'][-1]:.2f} dB")
    row: Row = {
        "capture": capture.name,
        "updates": updates,
        "measured": datetime.now(UTC).isoformat(timespec="seconds"),
        "core": core_version(),
        "curves": curves,
    }
    write_row(out / "convergence" / f"{capture.name}.json", row)
    return row


def read_convergence(out: Path, capture: str) -> Row | None:
    """Returns the measurements that ``measure_convergence`` wrote for a capture, or None if there are none."""
    return read_row(out / "convergence" / f"{capture}.json")


def once(settings: Settings) -> Settings:
    """Returns the settings with one attempt per frame and the same number of iterations in every update."""
    update = settings.update.model_copy(update={"reject_outliers": False, "cold_start_iterations": 1.0})
    return settings.model_copy(update={"update": update})


def _watched(capture: Capture, variant: Variant, out: Path, updates: int) -> list[dict[int, float]]:
    """Returns one curve per update: mean PSNR of the test cameras in dB, keyed by number of iterations."""
    reconstruction = started(capture, once(variant.settings), out)
    curves: list[dict[int, float]] = []
    for index in range(1, updates + 1):
        curve: dict[int, float] = {}
        true = capture.test_frame(index).images

        def look(done: int, engine: UpdateEngine, curve: dict[int, float] = curve, true: Any = true) -> None:
            if done in CHECKPOINTS:
                curve[done] = _psnr(reconstruction, capture, engine.state(learnt=True), true)

        updater, inner = reconstruction._prepared.updater, reconstruction._prepared.updater._engine
        updater._engine = WatchedEngine(inner, look)
        reconstruction.step(capture.frame(index))
        updater._engine = inner
        curve[variant.iterations] = _psnr(reconstruction, capture, reconstruction.history.gaussians(index), true)
        curves.append(curve)
    return curves


def _psnr(reconstruction: Any, capture: Capture, state: Gaussians, true: Any) -> float:
    """Returns the mean PSNR in dB of a state over the test cameras. The state need not be committed."""
    from scas4d_core.query.committed import CommittedScene
    from scas4d_core.storage.history import History

    held = History()
    held.append(0, 0.0, state, {})
    shown = CommittedScene(held, reconstruction.world, reconstruction._limits)
    assert capture.test_rig is not None
    cameras = capture.test_rig.cameras
    return float(np.mean([metrics.psnr(shown.render(camera).colour, true[camera.name]) for camera in cameras]))
