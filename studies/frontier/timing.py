"""Times of settings, measured alternately so that other load on the machine affects all of them equally.

Each setting has its own reconstruction. All of them run in one process and start from the frame 0 that the rows of the
study share. In each round, every setting processes the next frame, in an order that rotates from round to round. The
first round is not counted, because it loads kernels and has no motion to start from. Settings with many iterations are
timed only once. The result is the median time.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from client.cli.evaluate import Report
from client.cli.scores import Row, read_row, write_row
from client.importers.open_source import open_source
from scas4d_core.captures import Capture
from scas4d_core.warm_up import compile_in_processes
from studies.constants import all_varied
from studies.frontier.frontier import Variant
from studies.machine import core_version, machine

ROUNDS = 5
"""Number of counted rounds."""
MANY_ITERATIONS = 500
"""Settings with more iterations are timed once, because their times vary little and a round takes a minute."""


@dataclass
class TimedVariant:
    """A setting that is being timed: its reconstruction, and the seconds and stages of each counted update."""

    variant: Variant
    reconstruction: Any
    seconds: list[float] = field(default_factory=list)
    stages: list[dict[str, float]] = field(default_factory=list)

    def step(self, capture: Capture, index: int, *, counts: bool) -> float:
        """Reads a frame, updates the reconstruction and returns the seconds. Records them if ``counts`` is True."""
        started = time.perf_counter()
        with all_varied(self.variant.constants):
            done = self.reconstruction.step(capture.frame(index))
        seconds = time.perf_counter() - started
        if counts:
            self.seconds.append(seconds)
            self.stages.append({name: float(value) for name, value in done.seconds.items()})
        return seconds

    @property
    def medians(self) -> Row:
        """The settings, and the median seconds of an update and of its stages."""
        names = dict.fromkeys(name for stages in self.stages for name in stages)
        return {
            "label": self.variant.label,
            "settings": self.variant.record,
            "seconds": float(np.median(self.seconds)),
            "stages": {name: float(np.median([stages.get(name, 0.0) for stages in self.stages])) for name in names},
        }


def measure_times(folder: Path, variants: Sequence[Variant], out: Path, *, report: Report = print) -> Row:
    """Times settings on a capture and writes the result to ``out/timing/<capture>.json``.

    Results that only an earlier run measured are kept. Their times are scaled by the change in the first setting's
    time.

    Args:
        folder: capture folder.
        variants: settings to time; the first is the baseline. A missing frame 0 is fitted.
        out: study folder.
        report: callback that prints progress messages.

    Raises:
        ValueError: the capture has fewer than 3 frames.
    """
    compile_in_processes()
    # These imports load the kernels.
    from scas4d_core.kernels.jit import threads
    from studies.quality.first_frame import started

    capture = open_source(folder)
    turns = min(ROUNDS + 1, capture.frame_count - 1)
    if turns < 2:
        raise ValueError(f"{folder} has {capture.frame_count} frame(s); timing requires at least 3")
    timed = []
    for variant in variants:
        with all_varied(variant.constants):
            timed.append(TimedVariant(variant, started(capture, variant.settings, out)))
    for turn in range(turns):
        seconds = 0.0
        for place in range(len(timed)):
            one = timed[(turn + place) % len(timed)]
            if turn < 2 or one.variant.iterations <= MANY_ITERATIONS:
                seconds += one.step(capture, turn + 1, counts=turn > 0)
        report(f"    {capture.name}: round {turn} of {turns - 1}, {seconds:.1f} s")
    now = [one.medians for one in timed]
    row: Row = {
        "capture": capture.name,
        "measured": datetime.now(UTC).isoformat(timespec="seconds"),
        "core": core_version(),
        "machine": {**machine(), "threads": threads()},
        "rounds": turns - 1,
        "settings": now + _timed_before(read_times(out, capture.name), now),
    }
    write_row(out / "timing" / f"{capture.name}.json", row)
    return row


def read_times(out: Path, capture: str) -> Row | None:
    """Returns the times that ``measure_times`` wrote for a capture, or None if there are none."""
    return read_row(out / "timing" / f"{capture}.json")


def _timed_before(before: Row | None, now: Sequence[Row]) -> list[Row]:
    """Returns the results that only an earlier run measured, scaled to the current times.

    The result is empty if the two runs have different baselines.
    """
    if before is None or before["settings"][0]["settings"] != now[0]["settings"]:
        return []
    scale = now[0]["seconds"] / before["settings"][0]["seconds"]
    have = [answer["settings"] for answer in now]
    return [
        answer
        | {
            "seconds": scale * answer["seconds"],
            "stages": {name: scale * value for name, value in answer["stages"].items()},
        }
        for answer in before["settings"]
        if answer["settings"] not in have
    ]


def time_of(times: Row | None, variant: Variant) -> Row | None:
    """Returns the entry of a setting, or None if it was not timed."""
    wanted = variant.record
    return next((entry for entry in times["settings"] if entry["settings"] == wanted), None) if times else None
