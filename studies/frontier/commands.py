"""The command `scripts/bench frontier`."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer

from studies.options import FRONTIER, Captures

STEPS = ("rows", "times", "convergence", "page")


def frontier(
    captures: Captures,
    out: Annotated[Path, typer.Option(help="Study folder. A second run continues the study.")] = FRONTIER,
    axes: Annotated[
        list[str] | None, typer.Option(help="Measure only this axis, such as layers. May be repeated.")
    ] = None,
    updates: Annotated[int, typer.Option(min=1, help="Updates per row.")] = 5,
    most_iterations: Annotated[int | None, typer.Option(min=1, help="Skip settings with more iterations.")] = None,
    only: Annotated[
        list[str] | None, typer.Option(help="Run only this step: rows, times, convergence or page. May be repeated.")
    ] = None,
    rounds: Annotated[int, typer.Option(min=1, help="Timing rounds; each times every setting once.")] = 5,
    page: Annotated[
        Path | None,
        typer.Option(help="Markdown page to write; its plots go into a folder with the same name. [OUT/frontier.md]"),
    ] = None,
) -> None:
    """Measures accuracy against time: iterations of each method, and one setting at a time around the default.

    Rows, which contain the accuracy, can be measured on a busy machine. Times are measured by alternating between
    settings and require an idle machine. The page and its plots are then written from everything in the study's folder.

    Example: scripts/bench frontier captures/robot --axes iterations --axes layers
    """
    for step in only or ():
        if step not in STEPS:
            raise typer.BadParameter(f"unknown step {step!r}; choose from {', '.join(STEPS)}")
    steps = only or STEPS
    if "page" in steps:
        import_module("matplotlib")  # if missing, fail now and not after hours of measuring
    from studies.frontier.convergence import measure_convergence
    from studies.frontier.frontier import measure_frontier, variants
    from studies.frontier.page import write_page
    from studies.frontier.timing import measure_times

    if "rows" in steps:
        rows = measure_frontier(captures, out, axes or (), updates=updates, most_iterations=most_iterations)
        if any("error" in row for row in rows):
            raise typer.Exit(1)
    for capture in captures:
        if "times" in steps:
            measure_times(capture, variants(axes or (), most_iterations), out, rounds=rounds)
        if "convergence" in steps:
            measure_convergence(capture, out, updates=updates)
    if "page" in steps:
        file = page or out / "frontier.md"
        write_page(out, [capture.resolve().name for capture in captures], file, updates)
        print(f"wrote {file}")
