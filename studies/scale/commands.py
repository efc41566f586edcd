"""The command `scripts/bench scale`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from studies.options import Page, show


def scale(
    sweep: Annotated[
        list[str] | None,
        typer.Option(help="Run only this sweep: Gaussians, pixels, cameras, share that moves. May be repeated."),
    ] = None,
    work: Annotated[Path, typer.Option(help="Folder for the figures; existing ones are not measured again.")] = Path(
        "out/scale"
    ),
    out: Page = None,
) -> None:
    """Measures how time and memory grow with pixels, Gaussians, cameras and moving content.

    Growth is reported as an exponent.

    Example: NUMBA_NUM_THREADS=1 scripts/bench scale --sweep cameras
    """
    from studies.scale.scale import SWEEPS, run, summarize

    if unknown := set(sweep or []) - set(SWEEPS):
        raise typer.BadParameter(f"unknown sweep {sorted(unknown)[0]!r}; choose from {', '.join(SWEEPS)}")
    text = summarize(run(work.resolve(), sweep or list(SWEEPS), typer.echo))
    show(text, out)
