"""`scripts/bench exports`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from studies.options import Page, write_page


def exports(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="Folder of the capture.")],
    states: Annotated[
        Path, typer.Argument(metavar="STATES", help="Its committed states: `states` of `scas4d reconstruct`.")
    ],
    pictures: Annotated[
        Path | None, typer.Option(help="Leave state | export | difference of each format here.")
    ] = None,
    page: Page = None,
) -> None:
    """Exports the last state in every format of splats, reads it with another reader, and renders it beside the state.

    Needs the extras `exports` and `dev`. Example: scripts/bench exports captures/robot out/robot/states
    """
    from studies.exports.exports import measure, told

    text = told(measure(capture, states, pictures))
    print(text)
    write_page(page, text)
