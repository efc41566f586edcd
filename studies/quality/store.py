"""Rows of a study on disk, one file a row, so that an interrupted study goes on where it stopped."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

Row = dict[str, Any]
"""What was measured, JSON values by name; ``key`` names the row."""


class Store:
    """The rows of one study: ``rows/<key>.json`` when done, ``frames/<key>.jsonl`` a line a frame as they come."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for name in ("rows", "frames"):
            (folder / name).mkdir(parents=True, exist_ok=True)

    def row(self, key: str) -> Row | None:
        """A finished row; None where there is none, or where the last attempt failed."""
        path = self.folder / "rows" / f"{key}.json"
        if not path.exists():
            return None
        row: Row = json.loads(path.read_text())
        return None if "error" in row else row

    def rows(self) -> Iterator[Row]:
        """Every row on disk, failed ones too (they hold ``error``), by key."""
        for path in sorted((self.folder / "rows").glob("*.json")):
            yield json.loads(path.read_text())

    def put(self, row: Mapping[str, Any]) -> None:
        """Writes a row; the file is whole or not there."""
        path = self.folder / "rows" / f"{row['key']}.json"
        beside = path.with_suffix(f".{os.getpid()}.part")
        beside.write_text(json.dumps(row, indent=1))
        beside.replace(path)

    def start_frames(self, key: str) -> None:
        """Begins the per-frame lines of a row anew."""
        (self.folder / "frames" / f"{key}.jsonl").write_text("")

    def put_frame(self, key: str, frame: Mapping[str, Any]) -> None:
        """Adds one frame's line."""
        with (self.folder / "frames" / f"{key}.jsonl").open("a") as file:
            file.write(json.dumps(frame) + "\n")

    def frames(self, key: str) -> list[Row]:
        """The per-frame lines of a row."""
        return [json.loads(line) for line in (self.folder / "frames" / f"{key}.jsonl").read_text().splitlines()]


def digest(*parts: Any) -> str:
    """Eight hexadecimal digits that change with any of the JSON values given."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:8]
