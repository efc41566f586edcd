"""The command `scripts/bench paper`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from studies.options import FRONTIER, QUALITY, Captures


def paper(
    captures: Captures,
    out: Annotated[
        Path, typer.Option(help="Study folder, shared with frontier. A second run continues the study.")
    ] = FRONTIER,
    quality: Annotated[
        Path | None, typer.Option(help="Folder of the quality study, for captures that have rows only there.")
    ] = QUALITY,
    updates: Annotated[int, typer.Option(min=1, help="Updates per row.")] = 5,
    measure: Annotated[
        bool, typer.Option("--measure/--no-measure", help="Measure missing rows; otherwise leave them out.")
    ] = True,
    page: Annotated[Path | None, typer.Option(help="Markdown page to write. [OUT/paper.md]")] = None,
) -> None:
    """Reproduces the paper's experiments on captures and reports where the results agree with the paper's figures.

    Rows that are missing in the frontier study are measured first, beginning with the cheapest.
    After writing a page in docs/, record its figures: `scripts/figures.py page docs/paper-tables.md COMMAND`.

    Example: scripts/bench paper captures/robot --page docs/paper-tables.md
    """
    from studies.frontier.frontier import measure_variants
    from studies.paper.page import needed, write_paper_page

    if measure and any("error" in row for row in measure_variants(captures, needed(), out, updates=updates)):
        raise typer.Exit(1)
    file = page or out / "paper.md"
    write_paper_page(out, [capture.resolve().name for capture in captures], file, updates, quality)
    print(f"wrote {file}")
