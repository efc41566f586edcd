"""The rig studies as commands of `scripts/bench`: `rigs`, `calibration` and `drift`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from client.cli.capture_options import with_capture_options
from client.importers.open_source import CaptureOptions
from studies.options import QUALITY, Again, Captures, Changes

Study = Annotated[Path, typer.Option(help="Folder of the study: rows, pictures, frames 0. Run again to continue.")]


@with_capture_options
def rigs(
    captures: Captures,
    options: CaptureOptions,
    out: Study = QUALITY,
    frames: Annotated[int, typer.Option(min=1, help="At most so many.")] = 20,
    longer: Annotated[int, typer.Option(min=64, help="Pixels along the longer side of the largest picture.")] = 480,
    again: Again = False,
    changes: Changes = None,
) -> None:
    """Reconstructs captures of other rigs with default settings: seconds of frame 0, and a camera held out.

    Leaves rigs.md and a JSON file a row in the study's folder.

    Example: scripts/bench rigs captures/fly --frames 15
    """
    from studies.rigs.rigs import run

    run(captures, out, frames=frames, longer=longer, changes=changes or (), again=again, options=options)


def drift(
    captures: Captures,
    out: Study = QUALITY,
    updates: Annotated[int, typer.Option(min=1, help="Of each capture.")] = 14,
    pixels: Annotated[float, typer.Option(min=0, help="Of the files, that a camera drifts by in a frame.")] = 0.3,
    most: Annotated[float, typer.Option(min=0, help="Of the files, that it drifts by in all.")] = 4.0,
    again: Again = False,
    changes: Changes = None,
) -> None:
    """Updates captures of which two cameras drift, or none, with the effect pose_drift and without.

    Leaves drift.md in the study's folder; a run that was measured is not measured again.
    """
    from studies.rigs.pose_drift import run

    run(captures, out, updates=updates, pixels=pixels, most=most, changes=changes or (), again=again)


def calibration(
    captures: Captures,
    out: Study = QUALITY,
    fit: Annotated[bool, typer.Option(help="Fit frame 0 to rigs with faults, as given and refined.")] = True,
    again: Again = False,
    changes: Changes = None,
) -> None:
    """Puts faults into calibrations: what frame 0 reports of each, and what refining them is worth.

    Leaves calibration.md in the study's folder; a fit that was measured is not measured again.
    """
    from studies.rigs.calibration import run

    run(captures, out, fit=fit, changes=changes or (), again=again)
