"""The study of variants as a command of `scripts/bench`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from client.cli.capture_options import with_capture_options
from client.importers.open_source import CaptureOptions
from studies.options import Again, Captures, Page, write_page


@with_capture_options
def variants(
    captures: Captures,
    options: CaptureOptions,
    contender: Annotated[
        list[str],
        typer.Option(
            metavar="'NAME: CHANGE ...'",
            help="Settings that compete: a preset's name, or a name, a colon and changes as update.iterations=80, "
            "preset=adaptive, or a constant by its dotted name. The first is what the others are compared with.",
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder of the study: rows, frames 0. Run again to continue.")] = Path(
        "out/variants"
    ),
    variant: Annotated[list[str] | None, typer.Option(help="Only this variant; all when left out.")] = None,
    seed: Annotated[list[int] | None, typer.Option(min=0, help="Seed of the updates, default 0. Repeat it.")] = None,
    frames: Annotated[int | None, typer.Option(min=2, help="At most so many frames of each variant.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="The screen: half the pixels, six updates.")] = False,
    again: Again = False,
    page: Page = None,
) -> None:
    """Compares settings on variants of captures: backwards, every second frame, half of the cameras or pixels, later.

    Reports what each contender gains against the first on every variant, how often it is behind, and for each capture
    what the contender gains on it that wins on all others.

    Example: scripts/bench variants captures/robot captures/wheel --contender scas4d --contender adaptive --quick
    """
    from studies.variants.screen import Contender, run
    from studies.variants.variants import VARIANTS

    for name in variant or ():
        if name not in VARIANTS:
            raise typer.BadParameter(f"{name!r} is not one of {', '.join(VARIANTS)}", param_hint="--variant")
    try:
        contenders = [Contender.read(text) for text in contender]
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--contender") from error
    text = run(
        captures,
        contenders,
        out,
        variants=variant or (),
        seeds=seed or (0,),
        frames=frames,
        quick=quick,
        again=again,
        options=options,
    )
    write_page(page, text)
