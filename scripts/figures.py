"""Records measured figures in docs/figures.json, and writes them into README.md, CONTRIBUTING.md and docs/.

A record has a name, a date, the machine in words, and the command that measured it. It holds values, a table, or both.

- A value in a page is followed by a comment with its name, such as ``35.7<!-- robot.psnr --> dB``. It is written with
  as many decimals as the number that it replaces. ``robot.date`` can be used as well.
- A table in a page follows the line ``<!-- table: robot -->``, and is replaced as a whole.

Run it as ``PYTHONPATH=. python scripts/figures.py``, with one of these arguments::

    rows out/evaluate/rows/robot*.json           # records rows of `scas4d evaluate`
    time tests scripts/test                      # runs a command, and records its duration
    values NAME COMMAND median=1.25 worst=3.5    # records values that COMMAND has measured on this machine today
    table NAME COMMAND out/alarms/alarms.md 2    # records the second table of a Markdown file, in the same way
    page docs/kernels.md COMMAND                 # records what COMMAND has just written into a page
    --check                                      # exits with 1 if a page is out of date

``page`` records only values and tables that are new or differ from their records. All except ``--check`` then write the
figures into the pages, and so does a call without arguments.
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
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
TABLE = re.compile(r"^<!-- table: (?P<name>[\w-]+) -->\n(?P<table>(?:\|.*\n)*)", re.MULTILINE)
FIGURE = re.compile(r"(?P<text>\d{4}-\d\d-\d\d|(?:(?<![\w.])[-−+])?\d[\d,]*(?:\.\d+)?)<!-- (?P<name>[\w.-]+) -->")
ROW_VALUES = ("gaussians", "psnr_first", "psnr", "psnr_worst", "track_3d_median", "mte_2d", "seconds_update")
UNIT = r"(?:(?:dB|ms|s|seconds?|minutes?|hours?|kB|MB|GB|frames/s|frames per second|times|pixels)\b|%)"
NUMERAL = "half a|one|two|three|four|five|six|seven|eight|nine|ten|twenty|thirty|forty|fifty|sixty"
NUMBER_WITH_UNIT = re.compile(rf"(?<![\w.])\d[\d.,]*[\s-]?{UNIT}")
NUMERAL_WITH_UNIT = re.compile(rf"\b(?:{NUMERAL})[\s-]{UNIT}")
DATE = re.compile(r"\d{4}-\d\d-\d\d")

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
    return {**record, **record.get("values", {})}[key]


def format_like(text: str, value: Any) -> str:
    """Formats a value with the decimals of the text that it replaces, and commas from 1,000 on.

    >>> format_like("1.0", 35.68), format_like("1,000", 21821), format_like("2026-01-01", "2026-12-01")
    ('35.7', '21,821', '2026-12-01')
    >>> format_like("+1.0", 2.5), format_like("+1.0", -2.5)
    ('+2.5', '−2.5')
    """
    if isinstance(value, str):
        return value
    decimals = len(text.partition(".")[2])
    sign = "−" if value < 0 else "+" if text[0] == "+" else ""
    return f"{sign}{abs(value):{',' if abs(value) >= 1000 else ''}.{decimals}f}"


def parse(text: str) -> float:
    """Returns the value of a number in a page.

    >>> parse("1,200.5"), parse("−3"), parse("+3")
    (1200.5, -3.0, 3.0)
    """
    return float(text.replace(",", "").replace("−", "-"))


def with_figures(page: str, records: Records) -> str:
    """Returns the text of a page with the recorded values and tables.

    Raises:
        KeyError: if a value or table was not recorded.
    """

    def replace(match: re.Match[str]) -> str:
        text, name = match["text"], match["name"]
        return f"{format_like(text, value_of(records, name))}<!-- {name} -->"

    def replace_table(match: re.Match[str]) -> str:
        return "\n".join((f"<!-- table: {match['name']} -->", *records[match["name"]]["table"], ""))

    return TABLE.sub(replace_table, FIGURE.sub(replace, page))


def without_code(page: str) -> str:
    """Returns a page without code and tables of settings."""
    return re.sub(
        r"^```.*?^```|`[^`]*`|<!-- settings: .*?<!-- end of settings", "", page, flags=re.DOTALL | re.MULTILINE
    )


def without_figures(page: str) -> str:
    """Returns a page without recorded figures and tables."""
    return TABLE.sub("", FIGURE.sub("", page))


def unrecorded(page: str) -> list[str]:
    """Returns the numbers and numerals with units in a page that are not recorded, outside of code.

    >>> unrecorded("35.7<!-- robot.psnr --> dB and `10 s`, but 3 s and two minutes")
    ['3 s', 'two minutes']
    """
    text = without_figures(without_code(page))
    return NUMBER_WITH_UNIT.findall(text) + NUMERAL_WITH_UNIT.findall(text)


def unrecorded_in_sections(page: str) -> list[str]:
    """Returns the numbers with units that are not recorded in sections with recorded figures, and all dates.

    Limits and settings in such sections are written as code, to set them apart. Other sections describe no measurement.

    >>> unrecorded_in_sections("# Speed\\nTakes 3 s, 4<!-- a.b --> s or `5 s`.\\n# Limits\\nUp to 5 s, 2026-01-01.")
    ['3 s', '2026-01-01']
    """
    found = []
    for section in re.split(r"^(?=#+ )", without_code(page), flags=re.MULTILINE):
        text = without_figures(section)
        found += NUMBER_WITH_UNIT.findall(text) if FIGURE.search(section) or TABLE.search(section) else []
        found += DATE.findall(text)
    return found


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


def new_record(command: str, **measured: Any) -> dict[str, Any]:
    """Returns a record of what a command has measured on this machine today."""
    return {"command": command, "date": str(datetime.now(UTC).date()), "machine": in_words(machine()), **measured}


def record_time(command: list[str], run: Callable[[list[str]], Any]) -> dict[str, Any]:
    """Runs a command from the root of the project, and returns a record of its duration."""
    begin = time.monotonic()
    run(command)
    seconds = time.monotonic() - begin
    return new_record(shlex.join(command), values={"seconds": round(seconds, 1), "minutes": round(seconds / 60, 2)})


def tables_of(page: str) -> list[list[str]]:
    """Returns the lines of each table of a Markdown text.

    >>> tables_of("| a |\\n|---|\\n| 1 |\\n\\ntext\\n")
    [['| a |', '|---|', '| 1 |']]
    """
    return [found.splitlines() for found in re.findall(r"(?:^\|.*\n)+", page, re.MULTILINE)]


def record_page(page: str, command: str) -> Records:
    """Returns the records of the named values and tables of a page that a command has written on this machine.

    The date of a record is its own on the page, otherwise the last date before it, otherwise today's.
    """
    records: Records = {}
    date: dict[str, str] = {}
    for match in sorted([*FIGURE.finditer(page), *TABLE.finditer(page)], key=re.Match.start):
        name, _, key = match["name"].partition(".")
        record = records.setdefault(name, new_record(command) | date)
        if match.re is TABLE:
            record["table"] = match["table"].splitlines()
        elif key == "date":
            date = {"date": match["text"]}
            record |= date
        else:
            is_date = DATE.fullmatch(match["text"])
            record.setdefault("values", {})[key] = match["text"] if is_date else parse(match["text"])
    return records


def changed_records(page: str, measured: Records, known: Records) -> Records:
    """Returns the measured records of a page whose values, tables or dates are not those of the known records."""
    changed = set()
    for match in FIGURE.finditer(page):
        try:
            same = format_like(match["text"], value_of(known, match["name"])) == match["text"]
        except KeyError:
            same = False
        if not same:
            changed.add(match["name"].partition(".")[0])
    for name, record in measured.items():
        if "table" in record and record["table"] != known.get(name, {}).get("table"):
            changed.add(name)
    return {name: record for name, record in measured.items() if name in changed}


def main(arguments: list[str]) -> int:
    """Runs the command line; see the module's docstring."""
    records = load()
    if arguments[:1] == ["rows"]:
        records |= dict(record_rows([Path(path) for path in arguments[1:]]))
    elif arguments[:1] == ["time"] and len(arguments) > 2:
        run = lambda command: subprocess.run(command, cwd=ROOT, check=True)  # noqa: E731
        records[arguments[1]] = record_time(arguments[2:], run)
    elif arguments[:1] == ["values"] and len(arguments) > 3:
        pairs = [text.partition("=") for text in arguments[3:]]
        records[arguments[1]] = new_record(arguments[2], values={key: float(value) for key, _, value in pairs})
    elif arguments[:1] == ["table"] and len(arguments) == 5:
        table = tables_of(Path(arguments[3]).read_text())[int(arguments[4]) - 1]
        records[arguments[1]] = new_record(arguments[2], table=table)
    elif arguments[:1] == ["page"] and len(arguments) == 3:
        written = Path(arguments[1]).read_text()
        records |= changed_records(written, record_page(written, arguments[2]), records)
    elif arguments not in ([], ["--check"]):
        print(__doc__, file=sys.stderr)
        return 2
    pages = {page: with_figures(page.read_text(), records) for page in PAGES}  # fails before anything is written
    changed = [page for page, text in pages.items() if text != page.read_text()]
    if arguments != ["--check"]:
        save(records)
        for page in changed:
            page.write_text(pages[page])
        return 0
    for page in changed:
        print(f"{page.relative_to(ROOT)} is out of date: run scripts/figures.py", file=sys.stderr)
    return 1 if changed else 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
