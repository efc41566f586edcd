"""The commands `scripts/bench faults`, `views` and `memory`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from studies.options import Changes, Page, Repeated, show


def faults(
    capture: Repeated,
    frames: Annotated[int, typer.Option(min=4, help="Number of frames sent in each scenario.")] = 20,
    kills: Annotated[
        int, typer.Option(min=0, help="Number of kills (kill -9) of the worker or the service, or of nodes.")
    ] = 30,
    part: Annotated[
        list[str] | None,
        typer.Option(help="On a cluster, run only this part: nodes or head (requires redis-server). May be repeated."),
    ] = None,
    placement: Annotated[
        str, typer.Option(help="`local`, or `ray` for a Ray cluster of three nodes on this machine.")
    ] = "local",
    work: Annotated[Path, typer.Option(help="Folder for data folders and logs; its contents are deleted.")] = Path(
        "out/faults"
    ),
    out: Page = None,
    changes: Changes = None,
) -> None:
    """Kills the service and its workers, or the nodes and head of a cluster, and compares with an undisturbed run.

    Example: scripts/bench faults samples/robot --set static.iterations=300 --set update.iterations=20
    """
    from client.cli.changes import parse_changes
    from client.cli.extras import need_server
    from client.importers.open_source import open_source
    from studies.cluster import faults as of_nodes
    from studies.running.outcome import table
    from studies.running.study import Study, encoded_frames, undisturbed
    from studies.service import faults as of_faults

    need_server()
    if placement not in ("local", "ray"):
        raise typer.BadParameter(f"unknown placement {placement!r}; choose from local, ray", param_hint="--placement")
    if unknown := set(part or []) - set(of_nodes.PARTS):
        raise typer.BadParameter(f"unknown part {sorted(unknown)[0]!r}; choose from {', '.join(of_nodes.PARTS)}")
    opened = open_source(capture)
    study = Study(work.resolve(), opened, encoded_frames(opened, frames), parse_changes(changes), {})
    if placement == "local":
        outcomes = [of_faults.kills(study, *undisturbed(study), kills, 0, typer.echo)]
    else:
        outcomes = of_nodes.run(study, count=kills, seed=0, parts=part or of_nodes.PARTS, echo=typer.echo)
    text = table(outcomes)
    show(text, out)
    if not all(outcome.reached for outcome in outcomes):
        raise typer.Exit(1)


def views(
    capture: Repeated,
    updates: Annotated[int, typer.Option(min=1, help="Number of updates per turn, without and with views.")] = 8,
    turns: Annotated[int, typer.Option(min=1, help="Number of turns per rate.")] = 3,
    work: Annotated[Path, typer.Option(help="Folder for the service's data; its contents are deleted.")] = Path(
        "out/views"
    ),
    out: Page = None,
    changes: Changes = None,
) -> None:
    """Measures live views during updates: their latency under an open-loop load, and how much they slow the updates.

    Example: scripts/bench views captures/robot
    """
    from client.cli.changes import parse_changes
    from client.cli.extras import need_server
    from client.importers.open_source import open_source
    from studies.service import views as of_views

    need_server()
    rows = of_views.measure(
        open_source(capture),
        work.resolve(),
        updates=updates,
        turns=turns,
        settings=parse_changes(changes),
        echo=typer.echo,
    )
    text = of_views.page(rows, capture.name, updates, turns)
    show(text, out)


def memory(
    cameras: Annotated[int, typer.Option(min=1, help="Number of cameras in the rig.")] = 24,
    size: Annotated[int, typer.Option(min=16, help="Width and height of the images in pixels.")] = 256,
    gaussians: Annotated[int, typer.Option(min=100, help="Number of Gaussians in the scene.")] = 10_000,
    scale: Annotated[float, typer.Option(help="Value of the setting scene.image_scale.")] = 1.0,
    masks: Annotated[bool, typer.Option("--masks", help="Send frames with masks.")] = False,
) -> None:
    """Compares the peak memory of a worker with the service's estimate, and prints the result as JSON."""
    import json

    from client.cli.extras import need_server
    from studies.service.memory import measure

    need_server()
    typer.echo(json.dumps(measure(cameras, size, gaussians, scale, masks)))
