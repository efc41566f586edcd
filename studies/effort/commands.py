"""The command `scripts/bench effort`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from studies.options import FRONTIER, Captures

PARTS = ("report", "budgets", "adaptive")


def effort(
    captures: Captures,
    out: Annotated[Path, typer.Option(help="Folder of the study, shared with frontier.")] = FRONTIER,
    milliseconds: Annotated[
        list[float] | None, typer.Option(min=1, help="A budget; 500, 1000 and 2000 when left out. May be repeated.")
    ] = None,
    frames: Annotated[int, typer.Option(min=5, help="Played back and forth under each budget.")] = 50,
    updates: Annotated[int, typer.Option(min=1, help="For the adaptive preset; all of the capture at most.")] = 100,
    only: Annotated[list[str] | None, typer.Option(help="Only report, budgets or adaptive. May be repeated.")] = None,
) -> None:
    """Measures the cost of reports, how budgets in milliseconds are kept, and what the adaptive preset saves.

    Wants a quiet machine. The answers become a part of the page that `scripts/bench frontier --only page` writes.

    Example: scripts/bench effort captures/robot --milliseconds 500
    """
    for part in only or ():
        if part not in PARTS:
            raise typer.BadParameter(f"part {part!r} is unknown; choose of {', '.join(PARTS)}")
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
