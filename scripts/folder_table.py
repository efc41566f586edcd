"""Writes the table of folders in docs/architecture.md from the first docstring line of each package.

python scripts/folder_table.py            # writes
python scripts/folder_table.py --check    # exits with 1 if the page is out of date
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "architecture.md"
PACKAGES = ("scas4d_core", "server", "client", "studies")
BEGIN, END = "<!-- folders: written by scripts/folder_table.py -->\n", "<!-- end of folders -->"


def first_line(package: Path) -> str:
    """Returns the first line of a package's docstring.

    Raises:
        ValueError: the package has no docstring.
    """
    docstring = ast.get_docstring(ast.parse((package / "__init__.py").read_text(encoding="utf-8")))
    if not docstring:
        raise ValueError(f"{package}/__init__.py has no docstring; give it one line that says what the folder contains")
    return docstring.splitlines()[0].replace("``", "`")


def folders() -> Iterator[Path]:
    """Yields every package, parents before children."""
    for name in PACKAGES:
        yield from sorted(path.parent for path in (ROOT / name).rglob("__init__.py"))


def table() -> str:
    """Returns a Markdown table with one row per folder."""
    rows = [f"| `{folder.relative_to(ROOT)}/` | {first_line(folder)} |" for folder in folders()]
    return "\n".join(["| folder | contents |", "|---|---|", *rows]) + "\n"


def with_table(page: str) -> str:
    """Returns the text of the page with an up-to-date table."""
    before, rest = page.split(BEGIN)
    return before + BEGIN + table() + END + rest.split(END, 1)[1]


if __name__ == "__main__":
    text = PAGE.read_text(encoding="utf-8")
    if "--check" in sys.argv:
        raise SystemExit(text != with_table(text))
    PAGE.write_text(with_table(text), encoding="utf-8")
