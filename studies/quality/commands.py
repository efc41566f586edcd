"""The commands `scripts/bench refit`, `effects`, `targets` and `table`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from client.cli.capture_options import with_capture_options
from client.importers.open_source import CaptureOptions
from studies.options import QUALITY, Again, Captures, Changes, Study


@with_capture_options
def refit(
    captures: Captures,
    options: CaptureOptions,
    out: Study = QUALITY,
    frame: Annotated[int, typer.Option(help="Frame to fit; negative numbers count from the end.")] = -1,
    again: Again = False,
    changes: Changes = None,
) -> None:
    """Fits a later frame from scratch, as an upper bound for the updates, and reports how far they fall short of it.

    The figures for the updates come from `scripts/bench targets` in the same folder. Writes refit.md and a JSON file
    per row to the study's folder.

    Example: scripts/bench refit captures/visit --frame -1
    """
    from studies.quality.refit import run

    run(
        captures,
        out,
        frame=frame,
        changes=changes or (),
        again=again,
        options=options,
    )


@with_capture_options
def targets(
    captures: Annotated[Path, typer.Argument(metavar="CAPTURES", help="Folder that contains the captures.")],
    out: Study = QUALITY,
    run: Annotated[
        list[str] | None,
        typer.Option(help="Measure only this run, such as scas4d or dynamic3dgs. May be repeated."),
    ] = None,
    frames: Annotated[int | None, typer.Option(min=1, help="Number of frames, shown in the table.")] = None,
    again: Again = False,
) -> None:
    """Measures the rows that the targets need. `scripts/bench table` compares them with the targets."""
    from studies.quality.runs import measure_runs

    rows = measure_runs(captures, out, run or (), frames=frames, again=again)
    if any("error" in row for row in rows):
        raise typer.Exit(1)


def table(
    study: Annotated[Path, typer.Argument(help="Study folder.")] = QUALITY,
    out: Annotated[
        Path | None, typer.Option(help="Markdown page to write, with commands, machine, targets and rows.")
    ] = None,
) -> None:
    """Prints which targets the measured rows reach, as a Markdown table.

    Only rows with the settings of the current presets are used. If several rows qualify, the one with the most frames
    is used.

    After writing docs/quality.md with --out, record its figures: `scripts/figures.py page docs/quality.md COMMAND`.
    """
    from studies.quality.targets import compare, count_words, page, read_study, target_table

    if not study.is_dir():
        raise typer.BadParameter(
            f"{study} is not a folder; measure first: scripts/bench targets CAPTURES --out {study}"
        )
    rows = read_study(study)
    outcomes = compare(rows)
    print(target_table(outcomes))
    print(f"\n{count_words(outcomes)}.")
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(page(rows))
