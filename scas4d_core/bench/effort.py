"""Budgets and adaptive effort, kept to and paid for: how many milliseconds a frame took of those it may take, and what
a preset that spares effort spares, frame by frame in turns with the one that does not.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from scas4d_core.bench.machine import core_version, machine
from scas4d_core.bench.store import Row
from scas4d_core.bench.timing import started
from scas4d_core.captures import Capture, Frame, open_capture
from scas4d_core.presets import preset
from scas4d_core.settings import Settings

Report = Callable[[str], None]

TOLERANCE = 0.05
"""Of a budget that a frame may be off, or one iteration if that is more."""
FRAMES = 50
"""Of a capture played back and forth."""
COUNTED_FROM = 2
"""Updates before are not counted: the first has no motion to start from and knows no speed."""


def back_and_forth(capture: Capture, frames: int) -> Iterator[Frame]:
    """So many frames after the first, played to the end, back to the start and so on; time goes on."""
    count = capture.frame_count
    first, second = capture.frame(0), capture.frame(1)
    step = second.time - first.time
    for index in range(1, frames + 1):
        place = index % (2 * count - 2)
        shown = capture.frame(min(place, 2 * count - 2 - place))
        yield Frame(index, first.time + index * step, shown.images, shown.masks)


@dataclass
class Kept:
    """How one budget was kept: seconds of each counted frame, its iterations, and the seconds of one."""

    milliseconds: float
    seconds: list[float] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)
    each: list[float] = field(default_factory=list)

    def off(self) -> list[float]:
        """Milliseconds that each frame took more (+) or less than the budget."""
        return [1000 * seconds - self.milliseconds for seconds in self.seconds]

    def allowed(self) -> list[float]:
        """Milliseconds that each may be off."""
        return [max(TOLERANCE * self.milliseconds, 1000 * each) for each in self.each]

    def row(self) -> Row:
        """The answer for one budget; shares of frames."""
        off, allowed = np.array(self.off()), np.array(self.allowed())
        return {
            "milliseconds": self.milliseconds,
            "frames": len(off),
            "within": float((np.abs(off) <= allowed).mean()),
            "not_over": float((off <= allowed).mean()),
            "median_off_ms": float(np.median(off)),
            "worst_off_ms": float(off.max()),
            "iterations": np.percentile(self.iterations, (0, 50, 100)).tolist(),
            "off_ms": off.round(2).tolist(),
        }


def measure_budgets(
    folder: Path, out: Path, milliseconds: Sequence[float], *, frames: int = FRAMES, report: Report = print
) -> Row:
    """Plays a capture back and forth under each budget; leaves ``out/effort/<capture>-budgets.json``.

    A frame's time goes from before its pictures are decoded to the end of its commit, on disk and synced.

    Args:
        folder: of the capture. out: folder of a study, with its frames 0. milliseconds: the budgets.
    """
    capture = open_capture(folder)
    kept = []
    for budget in milliseconds:
        settings = _changed(preset("scas4d"), budget_ms=budget)
        one = Kept(budget)
        with tempfile.TemporaryDirectory() as directory:
            reconstruction = started(capture, settings, out, Path(directory))
            played = back_and_forth(capture, frames)
            for number in range(frames):
                began = time.perf_counter()
                frame = next(played)
                done = reconstruction.step(frame, started=began)
                seconds = time.perf_counter() - began
                if number >= COUNTED_FROM:
                    one.seconds.append(seconds)
                    one.iterations.append(done.iterations)
                    one.each.append(_each(done))
        kept.append(one)
        row = one.row()
        report(
            f"    {capture.name}, {budget:g} ms: {100 * row['within']:.0f} % within, {100 * row['not_over']:.0f} % not "
            f"over; {row['iterations'][1]:.0f} iterations; worst {row['worst_off_ms']:+.0f} ms"
        )
    return _leave(out, f"{capture.name}-budgets", capture, {"budgets": [one.row() for one in kept]})


def _each(report: Any) -> float:
    """Seconds of an iteration of an update."""
    points = report.curve
    if len(points) < 2:
        return 0.0
    last, first = points[-1], points[0]
    return float((last.milliseconds - first.milliseconds) / 1000 / max(1, last.iterations - first.iterations))


def _changed(settings: Settings, **changes: Any) -> Settings:
    return settings.model_copy(update={"update": settings.update.model_copy(update=changes)})


def _leave(out: Path, name: str, capture: Capture, answer: Row) -> Row:
    from scas4d_core.kernels.jit import threads

    row: Row = {
        "capture": capture.name,
        "measured": datetime.now(UTC).isoformat(timespec="seconds"),
        "core": core_version(),
        "machine": {**machine(), "threads": threads()},
        **answer,
    }
    path = out / "effort" / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(row, indent=1))
    return row
