"""Rows and times of the frontier as points of PSNR and seconds, and the comparison at equal time.

Accuracy comes from the rows, which cover the same updates for all settings of a capture. Seconds come from
``studies.frontier.timing``. If a setting was not timed, the seconds in its row are used. These are CPU seconds if the
row ran on one thread, because other load on the machine hardly affects CPU time. If the default was timed on the
capture, the row seconds are scaled by the default's ratio of timed seconds to row seconds. This makes all times of a
capture comparable.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from client.cli.scores import Row, Store
from studies.frontier.frontier import AXES, DEFAULT, METHODS, Variant, row_of, variants
from studies.frontier.timing import read_times, time_of

SCORES = (
    "psnr",
    "psnr_foreground",
    "ssim",
    "flip",
    "track_3d_median",
    "mte_2d",
    "mte_2d_oracle",
    "parts_ari",
)
"""Names of the scores in a row."""
BUDGETS = (25, 50, 100, 200, 300)
"""Iteration counts of the baseline whose run times are the times at which the methods are compared."""


@dataclass(frozen=True)
class Point:
    """One setting on one capture, or its mean over several captures.

    Attributes:
        variant: the setting.
        capture: capture name, or the names of the averaged captures.
        seconds: seconds per update; see the module docstring.
        stages: median seconds of each stage.
        scores: value of each of ``SCORES``; None if the capture has no ground truth for it.
    """

    variant: Variant
    capture: str
    seconds: float
    stages: Mapping[str, float]
    scores: Mapping[str, float | None]

    @property
    def psnr(self) -> float:
        """Mean PSNR over updates and test cameras, in dB."""
        value = self.scores["psnr"]
        assert value is not None  # every row has it
        return value


def read_points(out: Path, captures: Sequence[str], updates: int) -> list[Point]:
    """Returns a point for every setting that was measured on each capture, in the order of captures and axes."""
    rows = list(Store(out).rows())
    points = []
    for capture in captures:
        times = read_times(out, capture)
        default, scale = time_of(times, DEFAULT), 1.0
        if default is not None and (row := row_of(rows, DEFAULT, capture, updates)) is not None:
            scale = default["seconds"] / _own_seconds(row)
        for variant in variants():
            row = row_of(rows, variant, capture, updates)
            if row is not None:
                points.append(_point(variant, row, time_of(times, variant), scale))
    return points


def mean_points(points: Iterable[Point], captures: Sequence[str]) -> list[Point]:
    """Returns the mean over captures of each setting that was measured on all captures."""
    by_variant: dict[Variant, dict[str, Point]] = {}
    for point in points:
        by_variant.setdefault(point.variant, {})[point.capture] = point
    means = []
    for variant, rows in by_variant.items():
        if all(capture in rows for capture in captures):
            means.append(_mean(variant, [rows[capture] for capture in captures]))
    return means


def of_axis(points: Iterable[Point], axis: str, capture: str | None = None) -> list[Point]:
    """Returns the points of an axis, on one capture or on all captures."""
    return [p for p in points if p.variant in AXES[axis] and capture in (None, p.capture)]


def curve(points: Iterable[Point], method: str, capture: str | None = None) -> list[Point]:
    """Returns the points of a method, in ascending order of iterations."""
    points_of_method = [p for p in of_axis(points, "iterations", capture) if p.variant.preset == method]
    return sorted(points_of_method, key=lambda point: point.variant.iterations)


def undominated(points: Sequence[Point]) -> list[Point]:
    """Returns the points for which no other point is as fast and more accurate, in ascending order of seconds."""
    best: list[Point] = []
    for point in sorted(points, key=lambda point: (point.seconds, -point.psnr)):
        if not best or point.psnr > best[-1].psnr:
            best.append(point)
    return best


def psnr_at(points: Sequence[Point], seconds: float) -> float | None:
    """Returns the PSNR of a curve in dB at a given time, interpolated in log time, or None outside the curve.

    A setting that is slower than a more accurate one is excluded. With very few iterations, updates end far from the
    solution. Searching for lost objects then takes longer than more iterations would have.
    """
    ordered = undominated(points)
    if not ordered or not ordered[0].seconds <= seconds <= max(point.seconds for point in points):
        return None
    return float(np.interp(np.log(seconds), [np.log(p.seconds) for p in ordered], [p.psnr for p in ordered]))


@dataclass(frozen=True)
class EqualSeconds:
    """Comparison of both methods at the time that the baseline takes for a number of iterations.

    Attributes:
        capture: capture name.
        iterations: number of baseline iterations.
        seconds: seconds per update at which the methods are compared.
        psnr: interpolated PSNR of ``scas4d`` in dB; None if its curve does not cover this time.
        baseline_psnr: best measured PSNR of the baseline within this time, in dB.
    """

    capture: str
    iterations: int
    seconds: float
    psnr: float | None
    baseline_psnr: float

    @property
    def lead(self) -> float | None:
        """Lead of ``scas4d`` in dB, or None if its PSNR at this time is unknown."""
        return None if self.psnr is None else self.psnr - self.baseline_psnr


def equal_seconds(points: Sequence[Point], captures: Sequence[str]) -> list[EqualSeconds]:
    """Compares the methods at equal time, for every measured entry of ``BUDGETS``."""
    own, other = METHODS
    pairs = []
    for capture in captures:
        own_curve = curve(points, own, capture)
        others = curve(points, other, capture)
        for base in others:
            if base.variant.iterations in BUDGETS:
                psnr = psnr_at(own_curve, base.seconds)
                best = max(each.psnr for each in others if each.seconds <= base.seconds)
                pairs.append(EqualSeconds(capture, base.variant.iterations, base.seconds, psnr, best))
    return pairs


def _own_seconds(row: Row) -> float:
    """Returns the seconds of an update as stored in the row."""
    alone = row["machine"].get("threads") == 1 and "cpu_seconds_update" in row
    return float(row["cpu_seconds_update" if alone else "seconds_update"])


def _point(variant: Variant, row: Row, timed: Row | None, scale: float) -> Point:
    seconds = scale * _own_seconds(row)
    stages = {name: seconds * part / row["seconds_update"] for name, part in row["seconds_stages"].items()}
    known = timed or {"seconds": seconds, "stages": stages}
    scores = {name: row.get(name) for name in SCORES}
    return Point(variant, row["capture"], known["seconds"], known["stages"], scores)


def _mean(variant: Variant, points: Sequence[Point]) -> Point:
    """Returns the mean of points of one setting. Each score is averaged over the captures that have it."""
    names = dict.fromkeys(name for point in points for name in point.stages)
    return Point(
        variant,
        "mean of " + ", ".join(point.capture for point in points),
        seconds=float(np.mean([point.seconds for point in points])),
        stages={name: float(np.mean([point.stages.get(name, 0.0) for point in points])) for name in names},
        scores={name: _known_mean([p.scores[name] for p in points]) for name in SCORES},
    )


def _known_mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
