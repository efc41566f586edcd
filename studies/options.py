"""Command-line options, output functions and folders shared by several studies."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

QUALITY = Path("out/quality")
"""Default folder of the quality study. Other studies read its results."""
FRONTIER = Path("out/frontier")
"""Default folder of the study of accuracy against time, shared with the paper study."""

Repeated = Annotated[
    Path, typer.Argument(metavar="CAPTURE", help="Capture folder; a short capture is played back and forth.")
]
Captures = Annotated[list[Path], typer.Argument(metavar="CAPTURE...", help="Capture folders.")]
Study = Annotated[
    Path, typer.Option(help="Study folder, for rows, images and frames 0. A second run continues the study.")
]
Page = Annotated[Path | None, typer.Option(help="Also write the result to this file, as Markdown.")]
Changes = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="Change a setting: update.iterations=20. May be repeated."),
]
Again = Annotated[
    bool, typer.Option("--again", help="Measure existing rows again, starting from their stored frame 0.")
]


def write_part(path: Path, text: str) -> None:
    """Replaces the part of a page between two markers, which are the first and the last line of ``text``.

    The rest of the page is left unchanged. If the markers are missing, the text is appended.
    """
    begin, end = text.splitlines()[0], text.splitlines()[-1]
    old = path.read_text() if path.exists() else ""
    if begin in old and end in old:
        new = old[: old.index(begin)] + text + old[old.index(end) + len(end) :]
    else:
        new = f"{old.rstrip()}\n\n{text}\n".lstrip()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(new)


def show(text: str, page: Path | None) -> None:
    """Prints a text, and also writes it to a page if one is given, creating its folder if necessary."""
    print(text)
    if page is not None:
        page.parent.mkdir(parents=True, exist_ok=True)
        page.write_text(text if text.endswith("\n") else text + "\n")
