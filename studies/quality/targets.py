"""Targets for the method, and their comparison with measured rows."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from client.cli.scores import Row, Store, markdown
from studies.machine import provenance
from studies.marks import marked, marked_days, marked_table
from studies.quality.quality import OBJECT_CAPTURES
from studies.quality.runs import RUNS, measured_runs

KERNELS = "kernels"
"""Value of ``Target.run`` for figures from the kernel study (``studies.kernels``), which has no run."""

Rows = Mapping[tuple[str, str], Row]
"""Maps a run and a capture to their measured row."""


@dataclass(frozen=True)
class Target:
    """A target for one figure.

    Attributes:
        what: description of the figure.
        run: name from ``RUNS``, or ``KERNELS``.
        metric: name of a value in the row. "psnr" is averaged over the updates that all compared rows have. "loss" and
            "loss_worst" are the mean and the worst loss of the updates against frame 0.
        captures: captures that must each reach the target, or whose mean must reach it.
        sense: operator with which the figure is compared with the threshold.
        threshold: threshold in ``unit``; if None, the figure is only reported.
        unit: unit of the figure.
        over: run from which the figure is the difference, if any.
        mean: whether the mean over the captures is compared.
    """

    what: str
    run: str
    metric: str
    captures: tuple[str, ...]
    sense: Literal["≥", ">", "≤", "<", ""] = ""
    threshold: float | None = None
    unit: str = "dB"
    over: str | None = None
    mean: bool = False


TARGETS: tuple[Target, ...] = (
    Target("frame 0 PSNR", "scas4d", "psnr_first", ("robot",), "≥", 36.0),
    Target("frame 0 PSNR", "scas4d", "psnr_first", ("wheel", "pendulums", "spring"), "≥", 34.5),
    Target("frame 0 PSNR", "scas4d", "psnr_first", ("cloth",), "≥", 30.5),
    Target("frame 0 PSNR", "scas4d", "psnr_first", ("stage",), "≥", 30.0),
    Target("frame 0 without points and masks", "robot-unaided", "psnr_first", ("robot",), "≥", 35.0),
    Target(
        "frame 0 without points and masks − with both",
        "robot-unaided", "psnr_first", ("robot",), "≥", -1.0, over="scas4d",
    ),
    Target("number of Gaussians", "scas4d", "gaussians", ("robot",), "≤", 25_000, ""),
    Target("update PSNR", "scas4d", "psnr", ("robot",), "≥", 31.0),
    Target("update PSNR", "scas4d", "psnr", OBJECT_CAPTURES, "≥", 30.5, mean=True),
    Target("update PSNR (room with shadows)", "scas4d", "psnr", ("stage",), "≥", 27.0),
    Target("scas4d − dynamic3dgs, 100 iterations", "scas4d", "psnr", ("robot",), "≥", 8.0, over="dynamic3dgs"),
    Target(
        "scas4d − dynamic3dgs, 100 iterations",
        "scas4d", "psnr", ("wheel", "pendulums", "cloth", "spring", "stage", "basketball"), ">", 0.0,
        over="dynamic3dgs",
    ),
    Target("frame 0 from its point cloud (paper: 30.25)", "scas4d", "psnr_first", ("basketball",), "≥", 29.0),
    Target("mean PSNR loss relative to frame 0", "scas4d", "loss", ("basketball",), "≤", 0.5),
    Target("worst PSNR loss relative to frame 0", "scas4d", "loss_worst", ("basketball",), "≤", 1.0),
    Target("PSNR over pixels changed since frame 0", "scas4d", "psnr_changed", ("basketball",)),
    Target("frame 0 without a point cloud", "basketball-cloudless", "psnr_first", ("basketball",), "≥", 24.0),
    Target(
        "3D tracks, median error", "scas4d", "track_3d_median", ("robot", "pendulums", "cloth", "spring"),
        "≤", 0.8, "% of extent",
    ),
    Target("3D tracks, median error", "scas4d", "track_3d_median", ("wheel",), "≤", 2.0, "% of extent"),
    Target(
        "2D tracks without oracle, median error", "scas4d", "mte_2d", ("robot", "pendulums", "cloth", "spring"),
        "≤", 0.5, "% of diagonal",
    ),
    Target("parts, adjusted Rand index", "scas4d", "parts_ari", ("robot", "pendulums"), "≥", 0.7, ""),
    Target(
        "parts, scas4d − dynamic3dgs, 100 iterations",
        "scas4d", "parts_ari", ("robot", "pendulums"), ">", 0.0, "", "dynamic3dgs",
    ),
    Target("rasterizer-to-arithmetic ratio, frame 0", KERNELS, "ratio_rasterizer", ("robot",), "≤", 2.0, "×"),
    Target("rasterizer-to-arithmetic ratio, cloud", KERNELS, "ratio_rasterizer_cloud", ("robot",), "≤", 2.0, "×"),
    Target("update-to-rasterizer ratio", KERNELS, "ratio_update", ("robot",), "≤", 3.0, "×"),
    Target("peak memory, including frame 0", KERNELS, "peak_mb", ("robot",), "<", 1500.0, "MB"),
)  # fmt: skip
"""Targets in the order of the table."""


@dataclass(frozen=True)
class Verdict:
    """Evaluation of a target on one capture or on a mean; one line of the table.

    Attributes:
        target: target that was evaluated.
        capture: capture name, or "mean of …".
        value: the figure; None if any value that it depends on was not measured.
        parts: figures for the run and for the run with which it is compared; None if the target is not a difference.
        updates: number of updates that the figure covers, as text; "frame 0" if there are none.
        reached: whether the target is reached; None without a figure or threshold.
    """

    target: Target
    capture: str
    value: float | None
    parts: tuple[float, float] | None
    updates: str
    reached: bool | None

    @property
    def word(self) -> str:
        """Verdict as text for the table: "reached", "**missed**", "not measured", or empty without a threshold."""
        if self.value is None:
            return "not measured"
        return "" if self.reached is None else "reached" if self.reached else "**missed**"


@dataclass(frozen=True)
class Figure:
    """A target's figure on one capture: the value, its two operands if it is a difference, and the covered updates."""

    value: float
    parts: tuple[float, float] | None
    updates: str


def compare(rows: Rows, targets: Sequence[Target] = TARGETS) -> list[Verdict]:
    """Evaluates every target and returns one verdict per capture, or a single verdict for a mean."""
    verdicts = []
    for target in targets:
        figures = {capture: figure_of(target, capture, rows) for capture in target.captures}
        if target.mean:
            verdicts.append(_verdict(target, "mean of " + ", ".join(target.captures), _mean(list(figures.values()))))
        else:
            verdicts += [_verdict(target, capture, figure) for capture, figure in figures.items()]
    return verdicts


def figure_of(target: Target, capture: str, rows: Rows) -> Figure | None:
    """Returns the figure of a capture, or None if a required row or value is missing."""
    needed = [rows.get((run, capture)) for run in (target.run, target.over) if run is not None]
    there = [row for row in needed if row is not None]
    if len(there) < len(needed):
        return None
    updates = min(int(row.get("updates", 0)) for row in there)
    values = [_value(row, target.metric, updates) for row in there]
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        return None
    words = _updates(target.metric, there, updates)
    if target.over is None:
        return Figure(known[0], None, words)
    return Figure(known[0] - known[1], (known[0], known[1]), words)


def target_table(verdicts: Sequence[Verdict]) -> str:
    """Formats the measured verdicts as a Markdown table and lists the others in a sentence."""
    lines = ["| metric | capture | target | measured | result | updates |", "|---|---|---|---|---|---|"]
    for verdict in verdicts:
        if verdict.value is None:
            continue
        target = verdict.target
        must = "–"
        if target.threshold is not None:
            must = f"{target.sense} {_number(target, target.threshold)} {target.unit}".strip()
        measured = _number(target, verdict.value)
        if verdict.parts is not None:
            measured += f" ({_plain(target, verdict.parts[0])} vs. {_plain(target, verdict.parts[1])})"
        cells = [target.what, verdict.capture, must, measured, verdict.word, verdict.updates]
        lines.append("| " + " | ".join(cells) + " |")
    missing: dict[str, list[str]] = {}
    for verdict in verdicts:
        if verdict.value is None:
            missing.setdefault(verdict.target.what, []).append(verdict.capture)
    if missing:
        named = "; ".join(f"{what} ({', '.join(captures)})" for what, captures in missing.items())
        lines += ["", f"Not measured: {named}."]
    return "\n".join(lines)


def count_words(verdicts: Sequence[Verdict], mark: Callable[[str, str], str] = lambda text, _: text) -> str:
    """Returns a sentence with the numbers of targets that are reached, missed and not measured.

    Args:
        verdicts: the targets and their figures.
        mark: returns a number with its name in the page.
    """
    compared = [verdict for verdict in verdicts if verdict.target.threshold is not None]
    reached, missed = (sum(verdict.reached is answer for verdict in compared) for answer in (True, False))
    unknown = len(compared) - reached - missed
    counts = {"targets": len(compared), "reached": reached, "missed": missed, "unknown": unknown}
    words = {name: mark(str(count), f"quality-targets.{name}") for name, count in counts.items()}
    return (
        f"Of {words['targets']} targets, {words['reached']} are reached, {words['missed']} missed and "
        f"{words['unknown']} not measured"
    )


def read_study(folder: Path) -> dict[tuple[str, str], Row]:
    """Returns the rows of the runs in a study's folder and, if available, those of the kernel study."""
    rows = measured_runs(Store(folder))
    file = folder / f"{KERNELS}.json"
    if file.exists():
        kernels: Row = json.loads(file.read_text())
        rows[KERNELS, kernels["capture"]] = kernels
    return rows


def page(rows: Rows) -> str:
    """Returns a Markdown page with the commands, machine and date, the table of targets, and the underlying rows.

    Its figures are marked for ``scripts/figures.py``.
    """
    verdicts = compare(rows)
    days, machines, cores = provenance(rows.values())
    runs = [(name, run) for name, run in RUNS.items() if run.preset == "scas4d"]
    behind = [rows[name, capture] for name, run in runs for capture in run.captures if (name, capture) in rows]
    return f"""# Quality

This page compares the quality of rendered images, tracks and parts with targets, using each capture's test cameras and
ground truth. These commands measure missing rows and write the page (`CAPTURES` is the folder of captures):

```
scripts/bench targets CAPTURES
scripts/bench kernels CAPTURES/robot --store out/quality --out docs/kernels.md
scripts/bench table out/quality --out docs/quality.md
```

- Measured: {marked_days(days, "quality-targets")}.
- Machine: `{machines}`.
- Source versions of the core: {cores}.

An iteration is a forward and a backward pass over one training view. Results are averaged over the test cameras and the
updates in the column "updates". Differences are computed over the updates that both runs cover. The metrics are defined
in `scas4d_core/metrics/`. Because the machine is shared, times on other pages differ.

## Targets

{count_words(verdicts, marked)}.

{marked_table(target_table(verdicts), "quality-targets")}

## Rows

These runs use the default preset. The study folder also contains all other runs and the seconds per stage.
*MB* is the peak memory of a process that also scores all frames. The memory target excludes scoring.

{marked_table(markdown(behind), "quality-rows") if behind else "None yet."}
"""


def _value(row: Row, metric: str, updates: int) -> float | None:
    if metric in ("psnr", "loss", "loss_worst"):
        by_frame = row.get("psnr_by_frame")
        if not by_frame or updates < 1:
            return None
        chosen = np.array(by_frame[1 : 1 + updates])
        if metric == "psnr":
            return float(chosen.mean())
        return float(by_frame[0] - (chosen.mean() if metric == "loss" else chosen.min()))
    value = row.get(metric)
    return None if value is None else float(value)


def _updates(metric: str, rows: Sequence[Row], shared: int) -> str:
    """Describes which updates a figure covers: those that all rows share for PSNR, otherwise those of each row."""
    if metric == "psnr_first":
        return "frame 0"
    if "capture_frames" not in rows[0]:
        return "–"
    covered = [shared] if metric == "psnr" else list(dict.fromkeys(int(row["updates"]) for row in rows))
    whole = int(rows[0]["capture_frames"]) - 1
    return "all" if covered == [whole] else " and ".join(map(str, covered)) + f" of {whole}"


def _mean(figures: Sequence[Figure | None]) -> Figure | None:
    known = [figure for figure in figures if figure is not None]
    if not known or len(known) < len(figures):
        return None
    parts = [figure.parts for figure in known if figure.parts is not None]
    both = (float(np.mean([a for a, _ in parts])), float(np.mean([b for _, b in parts]))) if parts else None
    words = ", ".join(dict.fromkeys(figure.updates for figure in known))
    return Figure(float(np.mean([figure.value for figure in known])), both, words)


def _verdict(target: Target, capture: str, figure: Figure | None) -> Verdict:
    if figure is None:
        return Verdict(target, capture, None, None, "–", None)
    return Verdict(target, capture, figure.value, figure.parts, figure.updates, _reached(target, figure.value))


def _reached(target: Target, value: float) -> bool | None:
    """Returns whether the unrounded figure reaches the target, or None if the target has no threshold."""
    if target.threshold is None:
        return None
    return {
        "≥": value >= target.threshold,
        ">": value > target.threshold,
        "≤": value <= target.threshold,
        "<": value < target.threshold,
    }[target.sense]


def _number(target: Target, value: float) -> str:
    return f"{value:+.{_digits(target)}f}" if target.over else _plain(target, value)


def _plain(target: Target, value: float) -> str:
    return f"{value:,.{_digits(target)}f}"


def _digits(target: Target) -> int:
    return 0 if target.metric in ("gaussians", "peak_mb") else 3 if target.metric == "parts_ari" else 2
