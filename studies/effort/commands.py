"""The command `scripts/bench effort`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from studies.options import FRONTIER, Captures

PARTS = ("report", "budgets", "adaptive")


def effort(
    captures: Captures,
    out: Annotated[Path, typer.Option(help="Study folder, shared with frontier.")] = FRONTIER,
    milliseconds: Annotated[
        list[float] | None, typer.Option(min=1, help="Time budget; default 500, 1000 and 2000. May be repeated.")
    ] = None,
    frames: Annotated[int, typer.Option(min=5, help="Number of frames per budget, played back and forth.")] = 50,
    updates: Annotated[int, typer.Option(min=1, help="Maximum number of updates for the adaptive preset.")] = 100,
    only: Annotated[
        list[str] | None, typer.Option(help="Measure only this part: report, budgets or adaptive. May be repeated.")
    ] = None,
) -> None:
    """Measures the cost of reports, how closely time budgets are met, and how much the adaptive preset saves.

    Requires an idle machine. The results become part of the page that `scripts/bench frontier --only page` writes.

    Example: scripts/bench effort captures/robot --milliseconds 500
    """
    for part in only or ():
        if part not in PARTS:
            raise typer.BadParameter(f"unknown part {part!r}; choose from {', '.join(PARTS)}")
    from scas4d_core.warm_up import compile_in_processes
    from studies.effort.effort import measure_adaptive, measure_budgets
    from studies.effort.report import measure_report

    compile_in_processes()
    for capture in captures:
        if "report" in (only or PARTS):
            measure_report(capture, out)
        if "budgets" in (only or PARTS):
            measure_budgets(capture, out, milliseconds or (500.0, 1000.0, 2000.0), frames=frames)
        if "adaptive" in (only or PARTS):
            measure_adaptive(capture, out, updates=updates)
