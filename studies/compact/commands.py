"""The command `scripts/bench compact`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from studies.options import Page, show


def compact(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="Capture folder.")],
    states: Annotated[
        Path, typer.Argument(metavar="STATES", help="Committed states of the capture, from `scas4d reconstruct`.")
    ],
    frames: Annotated[
        int, typer.Option(min=2, help="Number of frames in the file; the states are repeated back and forth.")
    ] = 240,
    page: Page = None,
) -> None:
    """Writes states to a compact file and measures its size, its PSNR and track errors, and the read and write times.

    Example: scas4d reconstruct captures/robot --out out/robot; scripts/bench compact captures/robot out/robot/states
    """
    from studies.compact.compact import measure, summarize

    figures = measure(capture, states, frames, {}, None)
    text = summarize(figures)
    show(text, page)
