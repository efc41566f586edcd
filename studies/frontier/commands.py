"""The command `scripts/bench frontier`."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer

from studies.options import FRONTIER, Captures

STEPS = ("rows", "times", "page")


def frontier(
    captures: Captures,
    out: Annotated[Path, typer.Option(help="Study folder. A second run continues the study.")] = FRONTIER,
    axes: Annotated[
        list[str] | None, typer.Option(help="Measure only this axis, such as layers. May be repeated.")
    ] = None,
    updates: Annotated[int, typer.Option(min=1, help="Updates per row.")] = 5,
    only: Annotated[
        list[str] | None, typer.Option(help="Run only this step: rows, times or page. May be repeated.")
    ] = None,
    page: Annotated[
        Path | None,
        typer.Option(help="Markdown page to write; its plots go into a folder with the same name. [OUT/frontier.md]"),
    ] = None,
) -> None:
    """Measures accuracy against time: iterations of each method, and one setting at a time around the default.

    Rows, which contain the accuracy, can be measured on a busy machine. Times are measured by alternating between
    settings and require an idle machine. The page and its plots are then written from everything in the study's folder.
    After writing a page in docs/, record its figures: `scripts/figures.py page docs/accuracy-and-time.md COMMAND`.

    Example: scripts/bench frontier captures/robot --axes iterations --axes layers
    """
    for step in only or ():
        if step not in STEPS:
            raise typer.BadParameter(f"unknown step {step!r}; choose from {', '.join(STEPS)}")
    steps = only or STEPS
    if "page" in steps:
        import_module("matplotlib")  # if missing, fail now and not after hours of measuring
    from studies.frontier.frontier import measure_variants, variants
    from studies.frontier.page import write_page
    from studies.frontier.timing import measure_times

    if "rows" in steps:
        rows = measure_variants(captures, variants(axes or ()), out, updates=updates)
        if any("error" in row for row in rows):
            raise typer.Exit(1)
    for capture in captures:
        if "times" in steps:
            measure_times(capture, variants(axes or ()), out)
    if "page" in steps:
        file = page or out / "frontier.md"
        write_page(out, [capture.resolve().name for capture in captures], file, updates)
        print(f"wrote {file}")
