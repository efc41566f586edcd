"""The command `scripts/bench scale`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from studies.options import Page, write_page


def scale(
    sweep: Annotated[
        list[str] | None,
        typer.Option(help="Run only this sweep: Gaussians, pixels, cameras, share that moves. May be repeated."),
    ] = None,
    frames: Annotated[
        list[int] | None, typer.Option(min=0, help="Frames after which memory is measured; 0 to skip.")
    ] = None,
    work: Annotated[Path, typer.Option(help="Folder for the figures; existing ones are not measured again.")] = Path(
        "out/scale"
    ),
    picture: Annotated[Path | None, typer.Option(help="File of the plot, such as scale.png.")] = None,
    out: Page = None,
) -> None:
    """Measures how time and memory grow with pixels, Gaussians, cameras, moving content and frames.

    Growth is reported as an exponent.

    Example: NUMBA_NUM_THREADS=1 scripts/bench scale --sweep cameras
    """
    from studies.scale.scale import FRAMES, SWEEPS, plot, run, summarize

    if unknown := set(sweep or []) - set(SWEEPS):
        raise typer.BadParameter(f"unknown sweep {sorted(unknown)[0]!r}; choose from {', '.join(SWEEPS)}")
    counts = [count for count in frames or FRAMES if count]
    sizes_run = run(work.resolve(), sweep or list(SWEEPS), counts, typer.echo)
    text = summarize(sizes_run)
    typer.echo(text)
    write_page(out, text)
    if picture is not None:
        plot(sizes_run, picture)
