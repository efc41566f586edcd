"""``scripts/bench timing``: cameras that are not synchronized, and how well their time offsets are estimated.

A capture is played back and forth, as a stream of all its frames or of every second, third or fourth frame. Two cameras
may get images from the frames in between, one later and one earlier than the others, so their offsets are known
exactly. Such a stream is at least twice as fast as the capture.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple
from unittest import mock

import numpy as np

from client.cli.evaluate import Report, settings_record
from client.cli.scores import Column, Row
from client.importers.open_source import open_source
from client.rig.sequence import ping_pong
from scas4d_core.captures import Capture
from scas4d_core.captures.frame import Frame
from scas4d_core.frame_report import FrameReport
from scas4d_core.robust import timing
from scas4d_core.settings import Settings
from studies.quality.first_frame import started
from studies.quality.settings import settings_of
from studies.rows import RowStudy

COLUMNS = (
    Column("capture", "capture"),
    Column("frames taken", "step", "d"),
    Column("updates", "updates", "d"),
    Column("true", "true"),
    Column("found", "found"),
    Column("known", "known", "d"),
    Column("others, largest", "others", ".3f"),
    Column("named since update", "since"),
    Column("named wrongly", "wrong", "d"),
    Column("ms an update", "milliseconds", ".1f"),
    Column("of it", "share", ".1%"),
)


class Case(NamedTuple):
    """A case of the study.

    Attributes:
        step: number of capture frames per frame of the stream.
        shift: capture frames by which one camera is ahead of the others and another one is behind them; may be 0.
    """

    step: int
    shift: int


CASES = (Case(1, 0), Case(2, 0), Case(2, 1), Case(3, 1), Case(4, 1))


def run(
    captures: Sequence[Path],
    out: Path,
    *,
    updates: int = 24,
    changes: Sequence[str] = (),
    again: bool = False,
    report: Report = print,
) -> list[Row]:
    """Runs every case on each capture, prints the table and writes it to ``out/timing.md``.

    For the arguments, see ``scripts/bench timing --help``. A second call for the same folder resumes the study.

    Returns:
        One row per capture and case.
    """
    settings = settings_of("scas4d", None, 0, changes)
    study = RowStudy(out, "timing", COLUMNS, again=again, report=report)
    for folder in captures:
        for case in CASES:
            study.add(
                f"{folder.resolve().name}-{case.step}-{case.shift}",
                (settings_record(settings, ()), updates, case),
                partial(_row, folder, out, settings, updates, case),
                lambda row: (
                    f"{row['capture']}, every {row['step']}: {row['true'] or 'in step'}, "
                    f"found {row['found'] or 'none off'}"
                ),
            )
    return study.finish()


def _row(folder: Path, out: Path, settings: Settings, updates: int, case: Case) -> Row:
    capture = open_source(folder)
    names = capture.rig.names
    shifts = {names[2]: case.shift, names[len(names) // 2 - 1]: -case.shift} if case.shift else {}
    scene = started(capture, settings, out)
    with clocked() as spent:
        reports = [scene.step(played(capture, index, case.step, shifts)) for index in range(1, updates + 1)]
    row = summary(reports, {name: shift / case.step for name, shift in shifts.items()})
    whole = float(np.median([sum(report.seconds.values()) for report in reports]))
    row |= {"milliseconds": 1000 * float(np.median(spent)), "share": float(np.median(spent)) / whole}
    identity = {"capture": capture.name, "step": case.step, "settings": settings_record(settings, ())}
    return {**identity, **row}


def played(capture: Capture, index: int, step: int, shifts: Mapping[str, int]) -> Frame:
    """Returns frame ``index`` of a stream that plays a subsampled capture back and forth.

    Args:
        capture: capture to play.
        index: frame index in the stream.
        step: number of capture frames per stream frame.
        shifts: capture frames by which a camera is ahead (+) of the others or behind (−), keyed by camera name.
    """
    frame = capture.frame(ping_pong(abs(step * index), capture.frame_count))
    images, masks = dict(frame.images), dict(frame.masks)
    for name, shift in shifts.items():
        other = capture.frame(ping_pong(abs(step * index + shift), capture.frame_count))
        images[name] = other.images[name]
        if name in masks:
            masks[name] = other.masks[name]
    return replace(frame, index=index, time=index / 30, images=images, masks=masks)


@contextmanager
def clocked() -> Iterator[list[float]]:
    """Yields a list to which the seconds of each frame's timing checks are appended."""
    spent, looked = list[float](), timing.record_timing

    def record_timing(*given: Any) -> Any:
        began = perf_counter()
        observation = looked(*given)
        spent.append(perf_counter() - began)
        return observation

    with mock.patch.object(timing, "record_timing", record_timing):
        yield spent


def summary(reports: Sequence[FrameReport], true: Mapping[str, float]) -> Row:
    """Returns the row of a run, computed from its reports.

    Args:
        reports: reports of all frames of the run.
        true: true time offset of each camera in frames; cameras that are not keys are synchronized.
    """
    last = reports[-1].timing
    named = [{name for name, one in report.timing.items() if one["out_of_step"]} for report in reports]
    others = [abs(one["frames"]) for report in reports for name, one in report.timing.items() if name not in true]
    since = {name: next((k + 1 for k, names in enumerate(named) if name in names), None) for name in true}
    return {
        "updates": len(reports),
        "true": "; ".join(f"{name}: {offset:+.2f}" for name, offset in true.items()),
        "found": "; ".join(
            f"{name}: {last[name]['frames']:+.2f} ± {last[name]['error']:.2f}" if name in last else f"{name}: not known"
            for name in true
        ),
        "known": len(last),
        "others": max(others, default=float("nan")),
        "since": "; ".join("–" if at is None else str(at) for at in since.values()),
        "wrong": len({name for names in named for name in names} - set(true)),
    }
