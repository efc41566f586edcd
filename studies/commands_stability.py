"""`scripts/bench stability --frames`, `--captures`, `--service` and `--soak`: what the studies need, and their end."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import typer

FIRST = Path("out/quality/first")
"""Where `scripts/bench quality` keeps frames 0."""


def frame_studies(
    captures: Sequence[Path], store: Path, cases: Sequence[str], *, service: bool, soak: int | None
) -> None:
    """The soak, or the frame cases on the made-up footage or on captures; ends with 1 where something does not hold.

    Args:
        store: folder; the soak goes on in it, the rest begins anew.
    """
    from scas4d_core.warm_up import warm_up_elsewhere

    warm_up_elsewhere()
    if soak is not None:
        from studies.hard_frames.soak import Soak, table, violations

        rows = Soak(store / "soak").run(soak, told=lambda row: typer.echo(str(row)))
        typer.echo(table(rows))
        _end(violations(rows))
        return
    from scas4d_core.captures import open_capture
    from studies.hard_frames.footage import Filmed, MadeUp
    from studies.quality.job import settings_of

    footages: list[MadeUp | Filmed] = [Filmed(open_capture(path), settings_of("scas4d"), FIRST) for path in captures]
    failed: list[str] = []
    for footage in footages or [MadeUp()]:
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

            found = frames_study.study(footage, store / "frames", cases, typer.echo)
            typer.echo(frames_study.table(found))
            typer.echo(in_words(footage, cost(footage)))
            failed += [line.case.name for line in found if line.violations]
    _end(failed)


def _end(failed: Sequence[str]) -> None:
    for each in failed:
        typer.echo(f"does not hold: {each}")
    if failed:
        raise typer.Exit(1)
