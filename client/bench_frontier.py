"""`scas4d bench frontier` and `scas4d bench paper`: what accuracy costs in time, and the paper's tables."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

STUDY = Path("out/frontier")


def frontier(
    captures: Annotated[list[Path], typer.Argument(metavar="CAPTURE...", help="Folders with test cameras.")],
    out: Annotated[Path, typer.Option(help="Folder of the study. Run again to go on.")] = STUDY,
    axes: Annotated[
        list[str] | None, typer.Option(help="Only this axis, as iterations or layers. May be repeated.")
    ] = None,
    updates: Annotated[int, typer.Option(min=1, help="Of each row.")] = 5,
    most_iterations: Annotated[int | None, typer.Option(min=1, help="Leave out settings with more.")] = None,
) -> None:
    """Measures accuracy against time: iterations by method, and one setting at a time around the default.

    Example: scas4d bench frontier captures/robot --axes iterations --updates 5
    """
    from scas4d_core.bench.frontier import measure_frontier

    rows = measure_frontier(captures, out, axes or (), updates=updates, most_iterations=most_iterations)
    if any("error" in row for row in rows):
        raise typer.Exit(1)


def register(app: typer.Typer) -> None:
    """Adds the commands to `scas4d bench`."""
    app.command()(frontier)
