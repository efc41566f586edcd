"""`scripts/bench frontier` and `scripts/bench paper`: what accuracy costs in time, and the paper's tables."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

STUDY = Path("out/frontier")
STEPS = ("rows", "times", "convergence", "page")


def frontier(
    captures: Annotated[list[Path], typer.Argument(metavar="CAPTURE...", help="Folders with test cameras.")],
    out: Annotated[Path, typer.Option(help="Folder of the study. Run again to go on.")] = STUDY,
    axes: Annotated[
        list[str] | None, typer.Option(help="Only this axis, as iterations or layers. May be repeated.")
    ] = None,
    updates: Annotated[int, typer.Option(min=1, help="Of each row.")] = 5,
    most_iterations: Annotated[int | None, typer.Option(min=1, help="Leave out settings with more.")] = None,
    only: Annotated[
        list[str] | None, typer.Option(help="Only this step: rows, times, convergence or page. May be repeated.")
    ] = None,
    rounds: Annotated[int, typer.Option(min=1, help="In which every setting is timed once.")] = 5,
    page: Annotated[
        Path | None, typer.Option(help="The page, as Markdown; plots go into a folder of its name. [OUT/frontier.md]")
    ] = None,
) -> None:
    """Measures accuracy against time: iterations by method, and one setting at a time around the default.

    Rows (accuracy) may be measured beside other work; times are measured in turns and want a quiet machine. Then the
    page with its plots is written from all that the study's folder holds.

    Example: scripts/bench frontier captures/robot --axes iterations --axes layers
    """
    from studies.frontier.convergence import measure_convergence
    from studies.frontier.frontier import measure_frontier, variants
    from studies.frontier.page import write_page
    from studies.frontier.timing import measure_times

    for step in only or ():
        if step not in STEPS:
            raise typer.BadParameter(f"step {step!r} is unknown; choose of {', '.join(STEPS)}")
    steps = only or STEPS
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


def paper(
    captures: Annotated[list[Path], typer.Argument(metavar="CAPTURE...", help="Folders with test cameras.")],
    out: Annotated[Path, typer.Option(help="Folder of the study, shared with frontier. Run again to go on.")] = STUDY,
    quality: Annotated[
        Path | None, typer.Option(help="Folder of the study of the bars, for captures that have rows there alone.")
    ] = Path("out/quality"),
    updates: Annotated[int, typer.Option(min=1, help="Of each row.")] = 5,
    measure: Annotated[
        bool, typer.Option("--measure/--no-measure", help="Measure rows that are missing; else leave them out.")
    ] = True,
    page: Annotated[Path | None, typer.Option(help="The page, as Markdown. [OUT/paper.md]")] = None,
) -> None:
    """Reproduces the paper's experiments on captures, beside the paper's figures, and says where they agree.

    A capture without rows in either study is measured, its cheapest rows first.

    Example: scripts/bench paper captures/robot --page docs/paper-tables.md
    """
    from studies.frontier.frontier import measure_variants
    from studies.paper.page import needed, write_paper_page

    if measure and any("error" in row for row in measure_variants(captures, needed(), out, updates=updates)):
        raise typer.Exit(1)
    file = page or out / "paper.md"
    write_paper_page(out, [capture.resolve().name for capture in captures], file, updates, quality)
    print(f"wrote {file}")


def effort(
    captures: Annotated[list[Path], typer.Argument(metavar="CAPTURE...", help="Folders with test cameras.")],
    out: Annotated[Path, typer.Option(help="Folder of the study, shared with frontier.")] = STUDY,
    milliseconds: Annotated[
        list[float] | None, typer.Option(min=1, help="A budget; 500, 1000 and 2000 when left out. May be repeated.")
    ] = None,
    frames: Annotated[int, typer.Option(min=5, help="Played back and forth under each budget.")] = 50,
    updates: Annotated[int, typer.Option(min=1, help="For the adaptive preset; all of the capture at most.")] = 100,
    only: Annotated[list[str] | None, typer.Option(help="Only report, budgets or adaptive. May be repeated.")] = None,
) -> None:
    """Measures what reports cost, how budgets in milliseconds are kept, and what the adaptive preset spares.

    Wants a quiet machine.

    The answers become a part of the page that `scripts/bench frontier --only page` writes.

    Example: scripts/bench effort captures/robot --milliseconds 500
    """
    from scas4d_core.warm_up import warm_up_elsewhere
    from studies.effort.effort import measure_adaptive, measure_budgets
    from studies.effort.report import measure_report

    parts = ("report", "budgets", "adaptive")
    for part in only or ():
        if part not in parts:
            raise typer.BadParameter(f"part {part!r} is unknown; choose of {', '.join(parts)}")
    warm_up_elsewhere()
    for capture in captures:
        if "report" in (only or parts):
            measure_report(capture, out)
        if "budgets" in (only or parts):
            measure_budgets(capture, out, milliseconds or (500.0, 1000.0, 2000.0), frames=frames)
        if "adaptive" in (only or parts):
            measure_adaptive(capture, out, updates=updates)


def register(app: typer.Typer) -> None:
    """Adds the commands to `scripts/bench`."""
    app.command()(frontier)
    app.command()(paper)
    app.command()(effort)
