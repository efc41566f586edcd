"""Budgets and adaptive effort: how closely time budgets are met, and how much an adaptive preset saves."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.cli.evaluate import Report
from client.cli.scores import Row, write_row
from scas4d_core.captures import Capture
from scas4d_core.metrics import psnr as image_psnr
from scas4d_core.settings import Settings
from studies.captures import open_measured
from studies.effort.sequences import Shown, as_it_is, back_and_forth, repeated, slowed
from studies.machine import core_version, machine
from studies.quality.first_frame import started
from studies.quality.settings import settings_of

TOLERANCE = 0.05
"""Fraction of the budget by which a frame's time may deviate, or one iteration if that takes longer."""
FRAMES = 50
"""Number of frames that are played back and forth from a capture."""
FEW = 8
"""Maximum number of updates per capture with repeated or slowed frames."""
SEEDS = 3
"""Number of seeds for the updates of a capture that is played as recorded."""
SEEN_DB = 45.0
"""Upper limit of the PSNR in dB. Differences above this limit are invisible, and slowed captures reach 54 dB."""
COUNTED_FROM = 2
"""First update that is counted. Earlier ones have no previous motion to start from and no measured speed."""


@dataclass
class Kept:
    """Measurements under one time budget.

    Attributes:
        milliseconds: the budget in milliseconds.
        seconds: time of each frame in seconds.
        iterations: number of iterations of each frame.
        each: seconds per iteration of each frame.
    """

    milliseconds: float
    seconds: list[float] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)
    each: list[float] = field(default_factory=list)

    def off(self) -> list[float]:
        """Returns the deviation of each frame's time from the budget, in milliseconds."""
        return [1000 * seconds - self.milliseconds for seconds in self.seconds]

    def allowed(self) -> list[float]:
        """Returns the tolerance for each frame, in milliseconds."""
        return [max(TOLERANCE * self.milliseconds, 1000 * each) for each in self.each]

    def row(self) -> Row:
        """Returns the row of the budget, in which ``within`` and ``not_over`` are fractions of the frames."""
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
    """Plays a capture back and forth under each budget and writes ``out/effort/<capture>-budgets.json``.

    A frame's time is measured from the start of image decoding until its commit is synced to disk.

    Args:
        folder: capture folder.
        out: folder of a study that contains the states of frame 0.
        milliseconds: time budgets in milliseconds.
        frames: number of frames to play under each budget.
        report: callback that prints progress messages.
    """
    capture = open_measured(folder)
    kept = []
    for budget in milliseconds:
        settings = changed(settings_of("scas4d"), budget_ms=budget)
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
            f"    {capture.name}, {budget:g} ms: {100 * row['within']:.0f}% within, {100 * row['not_over']:.0f}% not "
            f"over; {row['iterations'][1]:.0f} iterations; worst {row['worst_off_ms']:+.0f} ms"
        )
    return leave(out, f"{capture.name}-budgets", capture, {"budgets": [one.row() for one in kept]})


def measure_adaptive(
    folder: Path, out: Path, *, name: str = "adaptive", updates: int = 10, seeds: int = SEEDS, report: Report = print
) -> Row:
    """Compares an adaptive preset with ``scas4d`` on a capture as recorded, with repeated frames, and slowed down.

    Writes ``out/effort/<capture>-<name>.json``.

    Args:
        folder: capture folder with test cameras.
        out: folder of a study that contains the states of frame 0.
        name: adaptive preset name.
        updates: number of updates to run on the capture.
        seeds: number of seeds for the capture as recorded, because the results of the first update vary with the seed.
        report: callback that prints progress messages.
    """
    capture = open_measured(folder)
    few = min(updates, FEW)
    sequences: dict[str, tuple[int, Callable[[], Iterator[Shown]]]] = {
        "as it is": (seeds, lambda: as_it_is(capture, updates)),
        "repeated": (1, lambda: repeated(capture, few)),
        "slowed": (1, lambda: slowed(capture, few, out)),
    }
    answers = []
    for what, (tries, frames) in sequences.items():
        turns = Turns(("scas4d", name))
        for seed in range(tries):
            fixed, spare = (changed(settings_of(key), seed=seed) for key in turns.names)
            turns.take(capture, (changed(fixed, skip_tolerance=-1.0), spare), frames(), out)
        answer = {"sequence": what, **turns.row()}
        answers.append(answer)
        difference = answer["psnr"][name] - answer["psnr"]["scas4d"]
        ratio = "" if answer["time_repeats"] is None else f", repeats {100 * answer['time_repeats']:.0f}%"
        report(f"    {capture.name}, {what}: {100 * answer['time']:.0f}% of the time{ratio}, {difference:+.2f} dB")
    return leave(out, f"{capture.name}-{name}", capture, {"name": name, "sequences": answers})


class Turns:
    """Two settings that process the same frames alternately, with the seconds and PSNR of each frame.

    Args:
        names: names of the two settings; the first is the baseline.
    """

    def __init__(self, names: tuple[str, str]) -> None:
        self.names = names
        self._seconds: dict[str, list[float]] = {name: [] for name in names}
        self._psnr: dict[str, list[list[float]]] = {name: [] for name in names}
        self._iterations: list[int] = []
        self._repeats: list[bool] = []

    def take(self, capture: Capture, settings: tuple[Settings, Settings], frames: Iterator[Shown], out: Path) -> None:
        """Runs both settings on a sequence of frames, starting from frame 0, and records the results."""
        pair = {name: started(capture, one, out) for name, one in zip(self.names, settings, strict=True)}
        for values in self._psnr.values():
            values.append([])
        for number, shown in enumerate(frames):
            for name in self.names if number % 2 else self.names[::-1]:
                began = time.perf_counter()
                done = pair[name].step(shown.frame, started=began)
                self._seconds[name].append(time.perf_counter() - began)
                self._psnr[name][-1].append(_score(pair[name], capture, shown.truth))
                if name == self.names[1]:
                    self._iterations.append(done.iterations)
            self._repeats.append(shown.repeats)

    def row(self) -> Row:
        """Returns the results over all sequences: PSNR in dB, and times relative to the first setting."""
        full, spared = (np.array(self._seconds[name]) for name in self.names)
        again = np.array(self._repeats)
        each = {name: [float(np.mean(values)) for values in self._psnr[name]] for name in self.names}
        return {
            "frames": len(self._psnr[self.names[0]][0]),
            "psnr": {name: float(np.mean(values)) for name, values in each.items()},
            "psnr_each": each,
            "seconds": {name: float(np.median(values)) for name, values in self._seconds.items()},
            "time": float(spared.sum() / full.sum()),
            "time_repeats": float(spared[again].mean() / full[~again].mean()) if again.any() else None,
            "iterations": np.percentile(self._iterations, (0, 50, 100)).tolist(),
        }


def _score(reconstruction: Any, capture: Capture, truth: Mapping[str, NDArray[np.float32]]) -> float:
    """Returns the mean PSNR in dB over the test cameras, each capped at ``SEEN_DB``."""
    cameras = capture.test_rig.cameras if capture.test_rig is not None else ()
    scores = [image_psnr(reconstruction.render(c).colour, truth[c.name]) for c in cameras]
    return float(np.mean(np.minimum(scores, SEEN_DB)))


def _each(report: Any) -> float:
    """Returns the seconds per iteration of an update, or 0 if its curve has fewer than two points."""
    points = report.curve
    if len(points) < 2:
        return 0.0
    last, first = points[-1], points[0]
    return float(
        (last["milliseconds"] - first["milliseconds"]) / 1000 / max(1, last["iterations"] - first["iterations"])
    )


def changed(settings: Settings, **changes: Any) -> Settings:
    """Returns a copy of the settings with some update settings changed."""
    return settings.model_copy(update={"update": settings.update.model_copy(update=changes)})


def leave(out: Path, name: str, capture: Capture, answer: Row) -> Row:
    """Writes a result to ``out/effort/<name>.json`` with the machine and the source version, and returns the row."""
    from scas4d_core.kernels.jit import threads

    row: Row = {
        "capture": capture.name,
        "measured": datetime.now(UTC).isoformat(timespec="seconds"),
        "core": core_version(),
        "machine": {**machine(), "threads": threads()},
        **answer,
    }
    write_row(out / "effort" / f"{name}.json", row)
    return row
