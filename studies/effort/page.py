"""Budgets and adaptive effort, as a section of the frontier page."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from client.cli.scores import Row
from studies.effort.effort import SEEDS, TOLERANCE
from studies.effort.report import TARGET

KEPT = 0.95
"""Fraction of the frames that must meet a budget."""
TIME, LOSS_DB, REPEATS = 0.60, 0.10, 0.10
"""Targets for the adaptive preset, relative to the fixed one.

The values are the fraction of the fixed preset's time, the PSNR loss in dB, and the fraction of the time on repeated
frames.
"""


def effort_text(out: Path, captures: Sequence[str]) -> str:
    """Returns the Markdown sections for which measurements exist, or an empty string if there are none."""
    budgets = _rows(out, captures, "budgets")
    adaptive = _rows(out, captures, "adaptive")
    report = _rows(out, captures, "report")
    return "\n".join(
        [
            *(_budgets(budgets) if budgets else []),
            *(_adaptive(adaptive) if adaptive else []),
            *(_report(report) if report else []),
        ]
    )


def _rows(out: Path, captures: Sequence[str], what: str) -> list[Row]:
    files = [out / "effort" / f"{name}-{what}.json" for name in captures]
    return [json.loads(file.read_text()) for file in files if file.exists()]


def _budgets(rows: Sequence[Row]) -> list[str]:
    lines = [
        "## Budgets in milliseconds",
        "",
        "Each capture is played back and forth under each budget (`scripts/bench effort`). Times are measured from",
        "before decoding to the end of the commit on disk, excluding the first two frames. The tolerance is the larger",
        f"of {100 * TOLERANCE:.0f}% of the budget and one iteration; {100 * KEPT:.0f}% of frames must meet it.",
        "",
        "| capture | budget, ms | within | not over | median error, ms | worst error, ms | median iterations | |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        for one in row["budgets"]:
            verdict = "reached" if one["within"] >= KEPT else "**missed**"
            lines.append(
                f"| {row['capture']} | {one['milliseconds']:g} | {100 * one['within']:.0f}% "
                f"| {100 * one['not_over']:.0f}% | {one['median_off_ms']:+.1f} | {one['worst_off_ms']:+.1f} "
                f"| {one['iterations'][1]:.0f} | {verdict} |"
            )
    return [*lines, ""]


def _adaptive(rows: Sequence[Row]) -> list[str]:
    lines = [
        "## Adaptive effort",
        "",
        "The preset `adaptive` alternates with `scas4d` at 100 iterations per frame. *Repeats* is the time of repeated",
        "frames; each frame is shown twice, and one is shown four times. *Slowed* is the capture at a third of its",
        "speed, rendered from interpolated states of a reconstruction. Unchanged captures are run with "
        f"{SEEDS} seeds; ± is their standard deviation.",
        "",
        "| capture | frames | time | dB | repeats | slowed: time | slowed: dB |",
        "|---|---|---|---|---|---|---|",
    ]
    losses, times, repeats = [], [], []
    for row in rows:
        by_sequence = {one["sequence"]: one for one in row["sequences"]}
        plain, again, slow = by_sequence["as it is"], by_sequence["repeated"], by_sequence["slowed"]
        losses.append(_gain(plain))
        times.append(plain["time"])
        repeats.append(again["time_repeats"])
        lines.append(
            f"| {row['capture']} | {plain['frames']} | {100 * plain['time']:.0f}% | {_gain(plain):+.2f} "
            f"({_told(plain, 'adaptive')} : {_told(plain, 'scas4d')}) | {100 * again['time_repeats']:.0f}% "
            f"| {100 * slow['time']:.0f}% | {_gain(slow):+.2f} |"
        )
    ok = max(times) <= TIME and min(losses) >= -LOSS_DB and max(repeats) <= REPEATS
    lines += [
        "",
        f"Mean: {100 * np.mean(times):.0f}% of the time, {np.mean(losses):+.2f} dB; "
        f"repeats {100 * np.mean(repeats):.0f}%. The target (at most {100 * TIME:.0f}% of the time with a "
        f"loss of at most {LOSS_DB:g} dB, and {100 * REPEATS:.0f}% for repeats) is "
        f"{'reached on every capture' if ok else '**missed** on some captures'}.",
        "",
    ]
    return lines


def _report(rows: Sequence[Row]) -> list[str]:
    lines = [
        "## Cost of the report",
        "",
        "The stage `report` of a `scas4d` update comprises stage timers, colour shifts, and assembling, writing and",
        "publishing the report.",
        "",
        "| capture | updates | report ms | report: % of an update | worst update | |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        verdict = "reached" if row["share"] <= TARGET else "**missed**"
        lines.append(
            f"| {row['capture']} | {row['updates']} | {row['milliseconds']:.1f} | {100 * row['share']:.2f}% "
            f"| {100 * row['share_worst']:.2f}% | {verdict} |"
        )
    return [*lines, "", f"Target: at most {100 * TARGET:.0f}% of an update.", ""]


def _gain(one: Row) -> float:
    """Returns the gain in dB of the adaptive preset over the fixed one."""
    return float(one["psnr"]["adaptive"] - one["psnr"]["scas4d"])


def _told(one: Row, name: str) -> str:
    """Formats the PSNR of a setting in dB, with its standard deviation over seeds."""
    return f"{one['psnr'][name]:.2f} ± {np.std(one['psnr_each'][name]):.2f}"
