"""The rig studies as commands of `scripts/bench`: `rigs` and `calibration`."""

from __future__ import annotations

from typing import Annotated

import typer

from client.cli.capture_options import with_capture_options
from client.importers.open_source import CaptureOptions
from studies.options import QUALITY, Again, Captures, Changes, Study


@with_capture_options
def rigs(
    captures: Captures,
    options: CaptureOptions,
    out: Study = QUALITY,
    frames: Annotated[int, typer.Option(min=1, help="Maximum number of frames.")] = 20,
    longer: Annotated[int, typer.Option(min=64, help="Longer side of the largest image in pixels.")] = 480,
    again: Again = False,
    changes: Changes = None,
) -> None:
    """Reconstructs captures of other rigs with default settings, and measures frame 0 and a held-out camera.

    Writes rigs.md and a JSON file per row to the study's folder.

    Example: scripts/bench rigs captures/fly --frames 15
    """
    from studies.rigs.rigs import run

    run(captures, out, frames=frames, longer=longer, changes=changes or (), again=again, options=options)


def calibration(
    captures: Captures,
    out: Study = QUALITY,
    fit: Annotated[bool, typer.Option(help="Fit frame 0 to faulty rigs, as given and refined.")] = True,
    again: Again = False,
    changes: Changes = None,
) -> None:
    """Adds faults to calibrations, and measures what frame 0 reports about each fault and how much refinement helps.

    Writes calibration.md to the study's folder. Fits that were already measured are not repeated.
    """
    from studies.rigs.calibration import run

    run(captures, out, fit=fit, changes=changes or (), again=again)
