"""Times of settings, measured alternately so that other load on the machine affects all of them equally.

Each setting has its own reconstruction. All of them run in one process and start from the frame 0 that the rows of the
study share. In each round, every setting processes the next frame, in an order that rotates from round to round. The
first round is not counted, because it loads kernels and has no motion to start from. Settings with many iterations are
timed only once. The result is the median time, and the median over the rounds of the ratio to the first setting.
"""

from __future__ import annotations

import json
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
    """A setting that is being timed: its reconstruction, and the seconds of each counted update."""

    variant: Variant
    reconstruction: Any
    seconds: list[float] = field(default_factory=list)
    cpu_seconds: list[float] = field(default_factory=list)
    stages: list[dict[str, float]] = field(default_factory=list)

    def step(self, capture: Capture, index: int, *, counts: bool) -> float:
        """Reads a frame, updates the reconstruction and returns the seconds. Records them if ``counts`` is True."""
        started, cpu = time.perf_counter(), time.process_time()
        with all_varied(self.variant.constants):
            done = self.reconstruction.step(capture.frame(index))
        seconds = time.perf_counter() - started
        if counts:
            self.seconds.append(seconds)
            self.cpu_seconds.append(time.process_time() - cpu)
            self.stages.append({name: float(value) for name, value in done.seconds.items()})
        return seconds


def measure_times(
    folder: Path, variants: Sequence[Variant], out: Path, *, rounds: int = ROUNDS, report: Report = print
) -> Row:
    """Times settings on a capture and writes the result to ``out/timing/<capture>.json``.

    Results that only an earlier run measured are kept. Their times are scaled by the change in the first setting's
    time.

    Args:
        folder: capture folder.
        variants: settings to time; the first is the baseline. A missing frame 0 is fitted.
        out: study folder.
        rounds: number of counted rounds.
        report: callback that prints progress messages.

    Raises:
        ValueError: no settings were given, there is less than one round, or the capture has fewer than 3 frames.
    """
    if not variants:
        raise ValueError("variants is empty; pass at least one setting to time")
    if rounds < 1:
        raise ValueError(f"rounds must be at least 1; got {rounds}")
    compile_in_processes()
    # These imports load the kernels.
    from scas4d_core.kernels.jit import threads
    from studies.quality.first_frame import started

    capture = open_source(folder)
    turns = min(rounds + 1, capture.frame_count - 1)
    if turns < 2:
        raise ValueError(f"{folder} has {capture.frame_count} frame(s); timing requires at least 3")
    timed = []
    for variant in _distinct(variants):
        with all_varied(variant.constants):
            timed.append(TimedVariant(variant, started(capture, variant.settings, out)))
    ratios: list[list[float]] = [[] for _ in timed]
    for turn in range(turns):
        taken: dict[int, float] = {}
        for place in range(len(timed)):
            number = (turn + place) % len(timed)
            if turn < 2 or number == 0 or timed[number].variant.iterations <= MANY_ITERATIONS:
                taken[number] = timed[number].step(capture, turn + 1, counts=turn > 0)
        if turn:
            for number, seconds in taken.items():
                ratios[number].append(seconds / taken[0])
        report(f"    {capture.name}: round {turn} of {turns - 1}, {sum(taken.values()):.1f} s")
    row: Row = {
        "capture": capture.name,
        "measured": datetime.now(UTC).isoformat(timespec="seconds"),
        "core": core_version(),
        "machine": {**machine(), "threads": threads()},
        "rounds": turns - 1,
        "settings": [_answer(one, ratios[number]) for number, one in enumerate(timed)],
    }
    row["settings"] += _timed_before(read_times(out, capture.name), row["settings"])
    write_row(out / "timing" / f"{capture.name}.json", row)
    return row


def read_times(out: Path, capture: str) -> Row | None:
    """Returns the times that ``measure_times`` wrote for a capture, or None if there are none."""
    return read_row(out / "timing" / f"{capture}.json")


def _timed_before(before: Row | None, now: Sequence[Row]) -> list[Row]:
    """Returns the results that only an earlier run measured, scaled to the current times.

    The result is empty if the two runs have different baselines.
    """
    if before is None:
        return []
    first, *others = before["settings"]
    if _unseeded(first["settings"]) != _unseeded(now[0]["settings"]):
        return []
    scale = now[0]["seconds"] / first["seconds"]
    have = [_unseeded(answer["settings"]) for answer in now]
    kept = [answer for answer in others if _unseeded(answer["settings"]) not in have]
    return [
        {
            **answer,
            "seconds": scale * answer["seconds"],
            "seconds_each": [round(scale * value, 4) for value in answer["seconds_each"]],
            "cpu_seconds": scale * answer["cpu_seconds"],
            "stages": {name: scale * value for name, value in answer["stages"].items()},
        }
        for answer in kept
    ]


def time_of(times: Row | None, variant: Variant) -> Row | None:
    """Returns the entry of a setting, regardless of its seeds, or None if it was not timed."""
    today = variant.record
    for entry in times["settings"] if times else ():
        if _unseeded(entry["settings"]) == _unseeded(today):
            timing: Row = entry
            return timing
    return None


def _distinct(variants: Sequence[Variant]) -> list[Variant]:
    """Returns one of all settings that differ only in seed and frame count, which do not affect the time."""
    by_settings = {json.dumps(_unseeded(v.record), sort_keys=True): v for v in variants[::-1]}
    chosen = set(by_settings.values())
    return [variant for variant in variants if variant in chosen]


def _unseeded(settings: Row) -> Row:
    return settings | {"update": {**settings["update"], "seed": 0}}


def _answer(one: TimedVariant, ratios: Sequence[float]) -> Row:
    names = dict.fromkeys(name for stages in one.stages for name in stages)
    return {
        "label": one.variant.label,
        "preset": one.variant.preset,
        "iterations": one.variant.iterations,
        "settings": one.variant.record,
        "gaussians": len(one.reconstruction.history.gaussians(0)),
        "seconds": float(np.median(one.seconds)),
        "seconds_each": [round(value, 4) for value in one.seconds],
        "cpu_seconds": float(np.median(one.cpu_seconds)),
        "ratio": float(np.median(ratios)),
        "stages": {name: float(np.median([stages.get(name, 0.0) for stages in one.stages])) for name in names},
    }
