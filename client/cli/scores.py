"""Scores of reconstructions: storage on disk with one file per row, and formatting as Markdown tables."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Row = dict[str, Any]
"""Measured JSON values, keyed by name; ``key`` identifies the row."""


def read_row(path: Path) -> Row | None:
    """Reads a row from its file; returns None if the file does not exist."""
    if not path.exists():
        return None
    row: Row = json.loads(path.read_text())
    return row


def write_row(path: Path, row: Mapping[str, Any]) -> None:
    """Writes a row to its file atomically, creating the folder if needed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_suffix(f".{os.getpid()}.part")
    beside.write_text(json.dumps(row, indent=1))
    beside.replace(path)


class Store:
    """Storage for the rows of one study.

    Finished rows are stored in ``rows/<key>.json``; during measurement, one line per frame is appended to
    ``frames/<key>.jsonl``.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for name in ("rows", "frames"):
            (folder / name).mkdir(parents=True, exist_ok=True)

    def row(self, key: str) -> Row | None:
        """Returns a finished row, or None if it does not exist or its last attempt failed."""
        row = read_row(self.folder / "rows" / f"{key}.json")
        return None if row is None or "error" in row else row

    def rows(self) -> Iterator[Row]:
        """Yields every row on disk, sorted by key; failed rows have an ``error``."""
        for path in sorted((self.folder / "rows").glob("*.json")):
            yield json.loads(path.read_text())

    def put(self, row: Mapping[str, Any]) -> None:
        """Writes a row atomically."""
        write_row(self.folder / "rows" / f"{row['key']}.json", row)

    def start_frames(self, key: str) -> None:
        """Clears the per-frame lines of a row."""
        (self.folder / "frames" / f"{key}.jsonl").write_text("")

    def put_frame(self, key: str, frame: Mapping[str, Any]) -> None:
        """Appends the line of one frame."""
        with (self.folder / "frames" / f"{key}.jsonl").open("a") as file:
            file.write(json.dumps(frame) + "\n")

    def frames(self, key: str) -> list[Row]:
        """Returns the per-frame lines of a row."""
        return [json.loads(line) for line in (self.folder / "frames" / f"{key}.jsonl").read_text().splitlines()]


def digest(*parts: Any) -> str:
    """Returns an eight-digit hexadecimal hash of the given JSON values."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:8]


@dataclass(frozen=True)
class Column:
    """Table column: its heading, the name of its value in a row, and its number format."""

    heading: str
    name: str
    form: str = ".2f"

    def cell(self, row: Row) -> str:
        """Formats the value of a row as text; a missing value becomes a dash."""
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
    Column("mTV × 100", "mtv", ".3f"),
    Column("3D %", "track_3d_median"),
    Column("lost parts", "parts_lost", ".0f"),
    Column("2D %", "mte_2d"),
    Column("2D % (oracle)", "mte_2d_oracle"),
    Column("visibility", "visibility_accuracy", ".3f"),
    Column("AJ", "tapvid_aj", ".3f"),
    Column("δ", "tapvid_within", ".3f"),
    Column("OA", "tapvid_oa", ".3f"),
    Column("parts ARI", "parts_ari", ".3f"),
    Column("ARI, found parts", "parts_ari_found", ".3f"),
    Column("alarms", "alarms", "d"),
    Column("s/update", "seconds_update"),
    Column("MB", "peak_mb", ".0f"),
)


def markdown(rows: Iterable[Row], columns: Sequence[Column] = QUALITY) -> str:
    """Formats rows as a Markdown table with one line per row; the line of a failed row ends with its error."""
    lines = ["| " + " | ".join(c.heading for c in columns) + " |", "|" + "---|" * len(columns)]
    for row in rows:
        if "error" in row:
            known = [c.cell(row) for c in columns if c.name in row]
            lines.append("| " + " | ".join([*known, f"failed: {row['error']}"]) + " |")
        else:
            lines.append("| " + " | ".join(c.cell(row) for c in columns) + " |")
    return "\n".join(lines)


def stage_table(rows: Sequence[Row]) -> str:
    """Formats the seconds per stage of all rows with updates as a Markdown table, slowest stage first.

    Returns an empty string if no row has updates.
    """
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
