"""Rows as a Markdown table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from studies.quality.store import Row

OBJECT_CAPTURES = ("robot", "wheel", "pendulums", "cloth", "spring")
"""The captures whose mean is reported beside them."""


@dataclass(frozen=True)
class Column:
    """One column: its heading, the name of the value in a row, and how it is written."""

    heading: str
    name: str
    form: str = ".2f"

    def cell(self, row: Row) -> str:
        """The value as text; a dash where there is none."""
        value: Any = row.get(self.name)
        if value is None or value == "":
            return "–"
        return format(value, self.form) if isinstance(value, int | float) else str(value)


QUALITY = (
    Column("capture", "capture"),
    Column("preset", "preset"),
    Column("it.", "iterations", "d"),
    Column("changes", "changes"),
    Column("Gaussians", "gaussians", ",d"),
    Column("updates", "updates", "d"),
    Column("frame 0 dB", "psnr_first"),
    Column("PSNR dB", "psnr"),
    Column("worst dB", "psnr_worst"),
    Column("fg dB", "psnr_foreground"),
    Column("changed dB", "psnr_changed"),
    Column("SSIM", "ssim", ".4f"),
    Column("FLIP", "flip", ".4f"),
    Column("3D %", "track_3d_median"),
    Column("2D %", "mte_2d"),
    Column("2D % (oracle)", "mte_2d_oracle"),
    Column("visibility", "visibility_accuracy", ".3f"),
    Column("parts ARI", "parts_ari", ".3f"),
    Column("s/update", "seconds_update"),
    Column("MB", "peak_mb", ".0f"),
)


def markdown(rows: Iterable[Row], columns: Sequence[Column] = QUALITY) -> str:
    """A Markdown table, one line a row; failed rows say so in the second half of the line."""
    lines = ["| " + " | ".join(c.heading for c in columns) + " |", "|" + "---|" * len(columns)]
    for row in rows:
        if "error" in row:
            known = [c.cell(row) for c in columns if c.name in row]
            lines.append("| " + " | ".join([*known, f"failed: {row['error']}"]) + " |")
        else:
            lines.append("| " + " | ".join(c.cell(row) for c in columns) + " |")
    return "\n".join(lines)


def stage_table(rows: Sequence[Row]) -> str:
    """A Markdown table of the seconds by stage of the rows that have updates, slowest stage first; empty for none."""
    timed = [row for row in rows if row.get("seconds_stages")]
    if not timed:
        return ""
    names = dict.fromkeys(name for row in timed for name in row["seconds_stages"])
    slowest = sorted(names, key=lambda name: -sum(row["seconds_stages"].get(name, 0.0) for row in timed))
    lines = [
        "| " + " | ".join(["capture", "preset", "it.", "update", *slowest]) + " |",
        "|" + "---|" * (4 + len(slowest)),
    ]
    for row in timed:
        stages = [row["seconds_stages"].get(name) for name in slowest]
        cells = ["–" if value is None else f"{value:.3f}" for value in stages]
        known = [row["capture"], row["preset"], str(row["iterations"]), f"{row['seconds_update']:.3f}"]
        lines.append("| " + " | ".join([*known, *cells]) + " |")
    return "\n".join(lines)


def with_means(rows: Sequence[Row], over: Sequence[str] = OBJECT_CAPTURES, label: str = "mean of objects") -> list[Row]:
    """The rows, and behind them the means of each variant that has all captures in ``over``.

    A variant is what has the same ``variant`` value; only numbers that every row of it has are averaged.
    """
    result = list(rows)
    for variant in dict.fromkeys(row["variant"] for row in rows if "error" not in row):
        of = {row["capture"]: row for row in rows if row["variant"] == variant and "error" not in row}
        if not all(name in of for name in over):
            continue
        chosen = [of[name] for name in over]
        mean: Row = {"capture": label, "preset": chosen[0]["preset"], "iterations": chosen[0]["iterations"]}
        mean["changes"] = chosen[0].get("changes")
        for column in QUALITY:
            values = [row.get(column.name) for row in chosen]
            if column.name in ("psnr_worst", "peak_mb"):
                continue
            if column.form.endswith("f") and all(isinstance(v, int | float) for v in values):
                mean[column.name] = sum(values) / len(values)  # type: ignore[arg-type]
        result.append(mean)
    return result
