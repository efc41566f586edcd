"""The commands `scripts/bench stability` (hard cases, frame cases and the soak test), `timing` and `alarms`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from client.cli.capture_options import with_capture_options
from client.importers.open_source import CaptureOptions
from studies.options import QUALITY, Again, Captures, Changes, write_part


def stability(
    cases: Annotated[
        list[str] | None,
        typer.Option(help="Run only cases whose name contains this text. May be repeated.", show_default=False),
    ] = None,
    fast: Annotated[bool, typer.Option("--fast", help="Skip slow cases, such as clustering a million points.")] = False,
    mutate: Annotated[
        bool, typer.Option("--mutate", help="Remove each guard in turn; continues an interrupted run.")
    ] = False,
    store: Annotated[Path, typer.Option(help="Folder for the mutation results.")] = Path("out/stability"),
    out: Annotated[Path | None, typer.Option(help="Page in which to replace the tables between the markers.")] = None,
    frames: Annotated[
        bool,
        typer.Option("--frames", help="Run the frame cases instead, and measure the cost of the checks."),
    ] = False,
    captures: Annotated[
        list[Path] | None, typer.Option(help="Run the frame cases on this capture. May be repeated.")
    ] = None,
    service: Annotated[bool, typer.Option("--service", help="Run the frame cases through a service instead.")] = False,
    soak: Annotated[
        int | None,
        typer.Option(min=1, help="Process this many frames of a small scene instead; continues an interrupted run."),
    ] = None,
) -> None:
    """Runs the catalogue of hard cases on every available backend and counts how often the guards were triggered.

    Examples: scripts/bench stability --cases NaN --cases fold; scripts/bench stability --captures captures/robot;
    scripts/bench stability --service; scripts/bench stability --soak 10000
    """
    if frames or captures or service or soak is not None:
        _frame_studies(captures or [], store, cases or [], service=service, soak=soak)
        return
    from studies.hard_cases import mutate as mutations
    from studies.hard_cases import run

    lines = run.run(cases, slow=not fast, echo=typer.echo)
    failing = mutations.study(store, typer.echo) if mutate else mutations.known(store)
    if out is not None:
        if cases or fast:
            raise typer.BadParameter("the page must contain all cases; omit --cases and --fast, or omit --out")
        write_part(out, run.page(lines, failing, *run.here()))
    if any(line.violations for line in lines) or (mutate and not all((failing or {}).values())):
        raise typer.Exit(1)


def timing(
    captures: Captures,
    out: Annotated[
        Path, typer.Option(help="Folder of the quality study, with its rows and stored frames 0.")
    ] = QUALITY,
    updates: Annotated[int, typer.Option(min=1, help="Updates per capture, played back and forth.")] = 24,
    masks: Annotated[bool, typer.Option(help="Use the captures' masks.")] = True,
    again: Again = False,
    changes: Changes = None,
) -> None:
    """Shifts two cameras of a capture in time and reports the estimated time offsets.

    Writes timing.md to the study's folder. Runs that were already measured are not repeated.
    """
    from studies.hard_frames.out_of_step import run

    run(captures, out, updates=updates, masks=masks, changes=changes or (), again=again)


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
    seed: Annotated[list[int] | None, typer.Option(min=0, help="Seed of the updates. May be repeated.")] = None,
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
    clean: Annotated[bool, typer.Option("--clean", help="Plant no faults.")] = False,
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
            seeds=seed or (0,),
            frames=frames,
            faults=() if clean else tuple(fault or ("",)),
            changes=changes or (),
            again=again,
            options=options,
        )
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error


def _frame_studies(
    captures: Sequence[Path], store: Path, cases: Sequence[str], *, service: bool, soak: int | None
) -> None:
    """Runs the soak test, or the frame cases on synthetic footage or captures. The exit code is 1 if a check fails.

    Args:
        captures: folders of captures for the frame cases; synthetic footage if empty.
        store: results folder. A soak test is resumed from it; everything else starts from scratch.
        cases: substrings of the names of the cases to run; all if empty.
        service: whether to run the frame cases through a service.
        soak: number of frames of the soak test; None to run the frame cases.
    """
    if soak is not None:
        from studies.hard_frames.soak import Soak, table, violations

        rows = Soak(store / "soak").run(soak, echo=lambda row: typer.echo(str(row)))
        typer.echo(table(rows))
        _end(violations(rows))
        return
    from studies.captures import open_measured
    from studies.hard_frames.footage import AnyFootage, CapturedFootage, SyntheticFootage
    from studies.quality.settings import settings_of

    footages: list[AnyFootage] = [
        CapturedFootage(open_measured(path), settings_of("scas4d"), QUALITY) for path in captures
    ]
    failed: list[str] = []
    for footage in footages or [SyntheticFootage()]:
        if service:
            from client.cli.extras import need_server
            from studies.service import hard_frames as stability

            need_server()
            lines, faults = stability.study(footage, store / "service", cases, typer.echo)
            typer.echo(stability.table(lines))
            failed += faults + [line.case.name for line in lines if line.violations]
        else:
            from studies.hard_frames import study as frames_study
            from studies.hard_frames.cost import cost, in_words

            results = frames_study.study(footage, store / "frames", cases, typer.echo)
            typer.echo(frames_study.table(results))
            typer.echo(in_words(footage, cost(footage)))
            failed += [line.case.name for line in results if line.violations]
    _end(failed)


def _end(failed: Sequence[str]) -> None:
    for each in failed:
        typer.echo(f"failed: {each}")
    if failed:
        raise typer.Exit(1)
