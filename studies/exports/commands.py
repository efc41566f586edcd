"""The command `scripts/bench exports`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from studies.options import Page, show


def exports(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="Capture folder.")],
    states: Annotated[
        Path, typer.Argument(metavar="STATES", help="Committed states of the capture, from `scas4d reconstruct`.")
    ],
    sheet: Annotated[
        Path | None, typer.Option(help="Contact sheet to write: state | export | difference per format.")
    ] = None,
    page: Page = None,
) -> None:
    """Exports the last state in every splat format, reads each file with a third-party reader, and renders the result.

    With ground truth, the moving parts in the `glb-parts` export of the whole capture, and the joints between
    parts, are compared with the true poses.
    Requires the extras `exports` and `dev`. Example: scripts/bench exports captures/robot out/robot/states
    """
    from studies.exports.exports import measure, summarize
    from studies.exports.exports import sheet as sheet_of
    from studies.exports.joint_truth import measure_joints, report
    from studies.exports.part_truth import measure_asset, told_asset

    figures = measure(capture, states)
    text = summarize(figures)
    if asset := measure_asset(capture, states):
        text += f"\n\nArticulated asset against the true poses:\n\n{told_asset(asset)}"
        text += f"\n\nJoints against the true poses:\n\n{report(*measure_joints(capture, states))}"
    if sheet is not None:
        sheet_of(figures).save(sheet)
    show(text, page)
