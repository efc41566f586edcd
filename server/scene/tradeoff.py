"""Trade-off between accuracy and time, computed from the newest frame reports and the replays of a scene."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import groupby
from math import floor, log10
from statistics import fmean, median
from typing import Any

from client.wire import CurveMean, FrameReportModel, FrameState, PointKind, TimeModel, TradeoffPoint
from scas4d_core.frame_outcome import OTHER_ORDERS

NEWEST = 64
"""Number of the newest frames whose reports are used."""
LADDER = (10, 25, 50, 100, 200, 300, 500)
"""Iteration counts to extrapolate if they were not measured."""
NEAR = 0.1
"""Relative distance to a measured number of iterations below which no point is extrapolated."""


def usable_reports(reports: Iterable[FrameReportModel], first: int) -> list[FrameReportModel]:
    """Returns the reports of the updates whose duration is a valid measurement.

    These updates were fully committed at the first attempt. The first frame is excluded. The first
    update is also excluded, because it is run in several view orders.

    Args:
        reports: frame reports.
        first: index of the first frame.
    """
    return [
        report
        for report in reports
        if report.state == FrameState.COMMITTED
        and report.index != first
        and report.iterations is not None
        and report.degraded is None
        and len(report.attempts) <= 1
        and "total" in report.seconds
        and OTHER_ORDERS not in report.seconds
    ]


def commit_milliseconds(reports: Iterable[FrameReportModel]) -> float:
    """Returns the median time to write a commit in milliseconds, or 0 if no report contains it."""
    known = [report.write_seconds for report in reports if report.write_seconds is not None]
    return 1000 * median(known) if known else 0.0


def measured_points(reports: Sequence[FrameReportModel]) -> list[TradeoffPoint]:
    """Returns one point for each measured pair of a number of iterations and a number of threads.

    The numbers of iterations are rounded to two significant digits.
    """
    write = commit_milliseconds(reports)
    points = []
    for (iterations, threads), group in _groups(reports, lambda report: (_rounded(report.iterations), report.threads)):
        errors = [report.errors.get(report.candidate or "end") for report in group]
        points.append(
            TradeoffPoint(
                kind=PointKind.MEASURED,
                iterations=iterations,
                milliseconds=median(1000 * report.seconds["total"] for report in group) + write,
                error=_mean(errors),
                psnr=_mean(report.psnr for report in group),
                frames=len(group),
                threads=threads,
            )
        )
    return points


def mean_curves(reports: Sequence[FrameReportModel]) -> list[CurveMean]:
    """Returns one mean loss curve for the updates with the same total number of iterations.

    The losses are means, and the times are medians. All numbers of iterations are rounded to two
    significant digits.
    """
    steps = [
        (_rounded(report.iterations), _rounded(point.iterations), point)
        for report in reports
        for point in report.curve
        if point.loss is not None
    ]
    return [
        CurveMean(
            planned=planned,
            iterations=iterations,
            milliseconds=median(point.milliseconds for *_, point in group),
            loss=fmean(point.loss for *_, point in group),
            frames=len(group),
        )
        for (planned, iterations), group in _groups(steps, lambda step: step[:2])
    ]


def time_model(reports: Sequence[FrameReportModel]) -> TimeModel | None:
    """Fits a time model that is linear in the number of iterations.

    The slope is the median over all updates. The slope of one update is measured between the first
    and the last point of its loss curve. The remaining time is assumed to be constant.

    Returns:
        The model, or None if no loss curve has two points.
    """
    slopes = []
    for report in reports:
        if len(report.curve) > 1:
            begin, end = report.curve[0], report.curve[-1]
            slopes.append((end.milliseconds - begin.milliseconds) / (end.iterations - begin.iterations))
    if not slopes:
        return None
    each = median(slopes)
    rest = [1000 * report.seconds["total"] - each * (report.iterations or 0) for report in reports if report.curve]
    return TimeModel(
        fixed=max(0.0, median(rest)) + commit_milliseconds(reports), per_iteration=each, frames=len(slopes)
    )


def extrapolated_points(
    model: TimeModel | None, known: Sequence[TradeoffPoint], threads: int | None
) -> list[TradeoffPoint]:
    """Returns points with a predicted time for the iteration counts that have not been measured.

    The points have no accuracy.

    Args:
        model: time model; None returns no points.
        known: measured points.
        threads: number of threads to which the model applies. Points with other numbers of threads
            do not count as measured.
    """
    if model is None:
        return []
    there = [point.iterations for point in known if point.threads == threads]
    return [
        TradeoffPoint(
            kind=PointKind.EXTRAPOLATED,
            iterations=iterations,
            milliseconds=model.fixed + model.per_iteration * iterations,
            error=None,
            psnr=None,
            frames=0,
            threads=threads,
        )
        for iterations in LADDER
        if all(abs(iterations - one) > NEAR * iterations for one in there)
    ]


def _groups(items: Sequence[Any], key: Any) -> list[tuple[Any, list[Any]]]:
    def order(item: Any) -> Any:
        return tuple(-1 if part is None else part for part in key(item))

    return [
        (key(group[0]), group) for _, members in groupby(sorted(items, key=order), order) if (group := list(members))
    ]


def _rounded(iterations: int | None) -> int:
    """Returns the number of iterations, rounded to two significant digits.

    Under a time budget, the number of iterations varies slightly.
    """
    if not iterations:
        return 0
    return round(iterations, min(0, 1 - floor(log10(iterations))))


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return fmean(known) if known else None
