"""The commands `scripts/bench timing` and `alarms`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from client.cli.capture_options import with_capture_options
from client.importers.open_source import CaptureOptions
from studies.options import QUALITY, Again, Captures, Changes


def timing(
    captures: Captures,
    out: Annotated[
        Path, typer.Option(help="Folder of the quality study, with its rows and stored frames 0.")
    ] = QUALITY,
    updates: Annotated[int, typer.Option(min=1, help="Updates per capture, played back and forth.")] = 24,
    again: Again = False,
    changes: Changes = None,
) -> None:
    """Shifts two cameras of a capture in time and reports the estimated time offsets.

    Writes timing.md to the study's folder. Runs that were already measured are not repeated.
    """
    from studies.hard_frames.out_of_step import run

    run(captures, out, updates=updates, changes=changes or (), again=again)


@with_capture_options
def alarms(
    captures: Captures,
    options: CaptureOptions,
    out: Annotated[
        Path, typer.Option(help="Study folder, for rows and frames 0. A second run continues the study.")
    ] = Path("out/alarms"),
    variant: Annotated[
        list[str] | None,
        typer.Option(
            help="Measure only this variant: as it is, backwards, every second, half the cameras, half the "
            "pixels or later. May be repeated; default: all."
        ),
    ] = None,
    frames: Annotated[
        int | None, typer.Option(min=2, help="Maximum number of frames without faults, at least those before them.")
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            help="Plant only this fault: moved, out of focus, dirty, exposure, white balance, noise, late, "
            "frozen or swapped. May be repeated; default: all."
        ),
    ] = None,
    again: Again = False,
    changes: Changes = None,
) -> None:
    """Counts false alarms on clean variants of captures, and planted faults of single cameras that are found.

    A fault lasts three frames. It counts as found if its camera raises an alarm. See docs/stability.md#alarms.

    Example: scripts/bench alarms captures/robot captures/visit --variant backwards --set scene.image_scale=0.5
    """
    from studies.hard_frames.alarms import run

    try:
        run(
            captures,
            out,
            variants=variant or (),
            frames=frames,
            faults=tuple(fault or ("",)),
            changes=changes or (),
            again=again,
            options=options,
        )
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
