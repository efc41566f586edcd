"""The commands `scripts/bench variants`, `gaps` and `confidence`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from client.cli.capture_options import with_capture_options
from client.importers.open_source import CaptureOptions
from studies.options import Again, Captures, Changes, Page, show


@with_capture_options
def variants(
    captures: Captures,
    options: CaptureOptions,
    contender: Annotated[
        list[str],
        typer.Option(
            metavar="'NAME: CHANGE ...'",
            help="Settings to compare: a preset's name, or a name, a colon and changes such as update.iterations=80, "
            "preset=adaptive, or a constant by its dotted name. The first contender is the baseline.",
        ),
    ],
    out: Annotated[
        Path, typer.Option(help="Study folder, for rows and frames 0. A second run continues the study.")
    ] = Path("out/variants"),
    variant: Annotated[list[str] | None, typer.Option(help="Measure only this variant; default: all.")] = None,
    seed: Annotated[list[int] | None, typer.Option(min=0, help="Seed of the updates. May be repeated.")] = None,
    frames: Annotated[int | None, typer.Option(min=2, help="Maximum number of frames per variant.")] = None,
    again: Again = False,
    page: Page = None,
) -> None:
    """Compares settings on variants of captures, such as reversed frames, or half the frames, cameras or pixels.

    Reports the gain of each contender over the first on every variant, and how often the contender is behind.

    Example: scripts/bench variants captures/robot captures/wheel --contender scas4d --contender adaptive --frames 7
    """
    from studies.variants.screen import Contender, run
    from studies.variants.variants import VARIANTS

    for name in variant or ():
        if name not in VARIANTS:
            raise typer.BadParameter(
                f"unknown variant {name!r}; choose from {', '.join(VARIANTS)}", param_hint="--variant"
            )
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
        again=again,
        options=options,
    )
    show(text, page)


@with_capture_options
def gaps(
    captures: Captures,
    options: CaptureOptions,
    step: Annotated[int, typer.Option(min=2, help="Update only every this many frames.")] = 3,
    queue: Annotated[int, typer.Option(min=1, help="Maximum number of unfinished frames.")] = 8,
    frames: Annotated[int | None, typer.Option(min=4, help="Maximum number of frames of each capture.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of frame 0 and the updates.")] = 0,
    page: Page = None,
    changes: Changes = None,
) -> None:
    """Updates captures with skipped frames, or with shorter updates, and compares both with updates of all frames.

    Example: scripts/bench gaps captures/robot captures/wheel --step 3
    """
    from studies.captures import open_measured
    from studies.quality.settings import settings_of
    from studies.variants.gaps import run

    settings = settings_of("scas4d", None, seed, changes or ())
    scale = settings.scene.image_scale
    jobs = [(options.open(path), open_measured(path, options, image_scale=scale), settings) for path in captures]
    text = run(jobs, frames, step, queue, typer.echo)
    show(text, page)


def confidence(
    captures: Captures,
    out: Annotated[Path, typer.Option(help="Study folder. A second run continues the study.")] = Path("out/confidence"),
    page: Page = None,
) -> None:
    """Fits the confidence of tracks on captures with known tracks, and reports its calibration on the one left out.

    Each capture is reconstructed as it is and backwards.

    Example: scripts/bench confidence captures/robot captures/wheel captures/cloth
    """
    from studies.variants.confidence import run

    if len(captures) < 2:
        raise typer.BadParameter("pass at least two captures, because one is left out", param_hint="CAPTURE...")
    text = run(captures, out)
    show(text, page)
