"""Records measured figures in docs/figures.json, and writes them into README.md and the pages of docs/.

A figure in a page is followed by a comment with its name, such as ``35.7<!-- robot.psnr --> dB``. It is written with as
many decimals as the number that it replaces. ``robot.date``, ``robot.machine`` and ``robot.command`` can be used as
well.

PYTHONPATH=. python scripts/figures.py rows out/evaluate/rows/robot*.json  # records rows of `scas4d evaluate`
PYTHONPATH=. python scripts/figures.py time tests scripts/test            # runs a command, and records its duration
PYTHONPATH=. python scripts/figures.py                                    # writes all figures into the pages
PYTHONPATH=. python scripts/figures.py --check                            # exits with 1 if a page is out of date
"""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from studies.machine import in_words, machine

ROOT = Path(__file__).parents[1]
RECORDS = ROOT / "docs" / "figures.json"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FIGURE = re.compile(r"(?P<text>\d{4}-\d\d-\d\d|\d[\d,]*(?:\.\d+)?)<!-- (?P<name>[\w.-]+) -->")
ROW_VALUES = ("gaussians", "psnr_first", "psnr", "psnr_worst", "track_3d_median", "mte_2d", "seconds_update")
UNIT = r"(?:(?:dB|ms|s|seconds?|minutes?|hours?|kB|MB|GB|frames/s|frames per second|times|pixels)\b|%)"
COUNT = r"\d[\d.,]*|half a|one|two|three|four|five|six|seven|eight|nine|ten|twenty|thirty|forty|fifty|sixty"
UNRECORDED = re.compile(rf"(?<![\w.])(?:{COUNT})[\s-]?{UNIT}")
"""A number or numeral with a unit, without the comment that names a figure."""

Records = dict[str, dict[str, Any]]


def load() -> Records:
    """Returns the recorded figures: for each group, its command, date and machine, and its values by name."""
    records: Records = json.loads(RECORDS.read_text())
    return records


def save(records: Mapping[str, Mapping[str, Any]]) -> None:
    """Replaces the recorded figures."""
    RECORDS.write_text(json.dumps(dict(sorted(records.items())), indent=1, ensure_ascii=False) + "\n")


def value_of(records: Records, name: str) -> Any:
    """Returns a figure by its name, ``GROUP.VALUE``.

    Raises:
        KeyError: if no such figure was recorded.
    """
    group, _, key = name.partition(".")
    record = records[group]
    return record["values"][key] if key in record["values"] else record[key]


def format_like(text: str, value: Any) -> str:
    """Formats a value with the decimals and separators of the text that it replaces.

    >>> format_like("1.0", 35.68), format_like("1,000", 21821), format_like("2026-01-01", "2026-12-01")
    ('35.7', '21,821', '2026-12-01')
    """
    if isinstance(value, str):
        return value
    decimals = len(text.partition(".")[2])
    return f"{value:{',' if abs(value) >= 1000 else ''}.{decimals}f}"


def with_figures(page: str, records: Records) -> str:
    """Returns the text of a page with the recorded figures."""

    def replace(match: re.Match[str]) -> str:
        text, name = match["text"], match["name"]
        return f"{format_like(text, value_of(records, name))}<!-- {name} -->"

    return FIGURE.sub(replace, page)


def unrecorded(page: str) -> list[str]:
    """Returns the numbers with units in a page that are not recorded figures, outside of code.

    >>> unrecorded("35.7<!-- robot.psnr --> dB and `10 s`, but 3 s and two minutes")
    ['3 s', 'two minutes']
    """
    text = re.sub(r"^```.*?^```|`[^`]*`", "", page, flags=re.DOTALL | re.MULTILINE)
    return UNRECORDED.findall(FIGURE.sub("", text))


def record_rows(paths: list[Path]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yields the capture and record of each row of `scas4d evaluate`.

    The rows must have been measured on this machine, because they do not name it.

    Raises:
        ValueError: if a row was not measured with default settings, or two rows have the same capture.
    """
    known: set[str] = set()
    for path in paths:
        row = json.loads(path.read_text())
        if row["preset"] != "scas4d" or row["changes"]:
            settings = f"{row['preset']} {row['changes']}"
            raise ValueError(f"{path}: measured with {settings}; measure it with default settings")
        if row["capture"] in known:
            raise ValueError(f"{path}: another row of {row['capture']} was given; pass one row per capture")
        known.add(row["capture"])
        values = {key: row[key] for key in ROW_VALUES if row.get(key) is not None}
        yield (
            row["capture"],
            {
                "command": f"scas4d evaluate CAPTURES/{row['capture']}",
                "date": row["measured"][:10],
                "machine": in_words(machine()),
                "values": {key: round(value, 4) for key, value in values.items()},
            },
        )


def record_time(command: list[str], run: Callable[[list[str]], Any]) -> dict[str, Any]:
    """Runs a command from the root of the project, and returns a record of its duration."""
    begin = time.monotonic()
    run(command)
    seconds = time.monotonic() - begin
    return {
        "command": shlex.join(command),
        "date": str(datetime.now(UTC).date()),
        "machine": in_words(machine()),
        "values": {"seconds": round(seconds, 1), "minutes": round(seconds / 60, 2)},
    }


def main(arguments: list[str]) -> int:
    """Runs the command line; see the module's docstring."""
    if arguments[:1] == ["rows"]:
        save(load() | dict(record_rows([Path(path) for path in arguments[1:]])))
    elif arguments[:1] == ["time"] and len(arguments) > 2:
        run = lambda command: subprocess.run(command, cwd=ROOT, check=True)  # noqa: E731
        save(load() | {arguments[1]: record_time(arguments[2:], run)})
    elif arguments not in ([], ["--check"]):
        print(__doc__, file=sys.stderr)
        return 2
    records = load()
    pages = {page: with_figures(page.read_text(), records) for page in PAGES}
    changed = [page for page, text in pages.items() if text != page.read_text()]
    if arguments != ["--check"]:
        for page in changed:
            page.write_text(pages[page])
        return 0
    for page in changed:
        print(f"{page.relative_to(ROOT)} is out of date: run scripts/figures.py", file=sys.stderr)
    return 1 if changed else 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
