"""`scripts/bench processors`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command()(processors)


def processors(
    captures: Annotated[list[Path], typer.Argument(metavar="CAPTURE...", help="Folders with test cameras.")],
    out: Annotated[Path, typer.Option(help="Folder of the study. Run again to go on.")] = Path("out/processors"),
    frames: Annotated[int, typer.Option(min=1, help="Updates of each run.")] = 5,
    seeds: Annotated[int, typer.Option(min=1, help="Of the updates, on this processor.")] = 4,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="A setting, as update.iterations=20. May be repeated."),
    ] = None,
) -> None:
    """Compares a capture's result on this processor with that on lesser ones, beside the spread over seeds.

    Kernels, numpy and BLAS compute as on a processor with AVX2 alone, and as on one of 2008 (x86-64). Ends with 1
    where a state has other bits.
    """
    from studies.quality import processors as of_processors

    if not of_processors.run(captures, out, frames=frames, seeds=seeds, changes=changes or ()):
        raise typer.Exit(1)
