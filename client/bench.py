"""`scas4d bench`: the studies of `scas4d_core.bench`, imported when one runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(no_args_is_help=True, help="Studies that measure the method.")


@app.command()
def quality(
    captures: Annotated[list[Path], typer.Argument(metavar="CAPTURE...", help="Folders with test cameras.")],
    out: Annotated[Path, typer.Option(help="Rows and pictures; run again to go on.")] = Path("out/quality"),
    preset: Annotated[list[str] | None, typer.Option(help="Named settings; may be repeated.")] = None,
    iterations: Annotated[list[int] | None, typer.Option(min=1, help="Of an update; may be repeated.")] = None,
    seed: Annotated[list[int] | None, typer.Option(min=0, help="May be repeated.")] = None,
    frames: Annotated[int | None, typer.Option(min=1, help="Only so many frames.")] = None,
    device: Annotated[str | None, typer.Option(help="cpu or cuda.")] = None,
    masks: Annotated[bool, typer.Option(help="Give the method the masks.")] = True,
    points: Annotated[bool, typer.Option(help="Give the method the initial cloud.")] = True,
    lpips: Annotated[bool, typer.Option(help="Also LPIPS, where its weights are installed.")] = False,
    again: Annotated[bool, typer.Option(help="Measure anew what is there already.")] = False,
    changes: Annotated[list[str] | None, typer.Option("--set", metavar="NAME=VALUE")] = None,
) -> None:
    """How good pictures, tracks and parts are, and how long an update takes."""
    from scas4d_core.bench.quality import run

    rows = run(
        captures,
        out,
        preset or ["scas4d"],
        iterations=iterations or (),
        seeds=seed or (0,),
        overrides=changes or (),
        device=device,
        frames=frames,
        masks=masks,
        points=points,
        lpips=lpips,
        again=again,
    )
    if any("error" in row for row in rows):
        raise typer.Exit(1)
