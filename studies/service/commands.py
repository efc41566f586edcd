"""The commands `scripts/bench faults`, `ingest`, `views`, `memory` and `sleeping`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from studies.options import Changes, Page, Repeated, write_page


def faults(
    capture: Repeated,
    frames: Annotated[int, typer.Option(min=4, help="Number of frames sent in each scenario.")] = 20,
    kills: Annotated[
        int,
        typer.Option(
            min=0, help="Number of kills (kill -9) of the worker or the service, and of interrupted restarts."
        ),
    ] = 30,
    cuts: Annotated[int, typer.Option(min=0, help="Number of log files to truncate.")] = 20,
    flips: Annotated[int, typer.Option(min=0, help="Number of log files in which to flip a bit.")] = 1,
    bits: Annotated[
        int, typer.Option(min=0, help="Number of bits to flip, one by one, in states, checkpoints, journal and frames.")
    ] = 200,
    turns: Annotated[
        int, typer.Option(min=1, help="Number of turns without and with strangers, each with and without a token.")
    ] = 3,
    part: Annotated[
        list[str] | None,
        typer.Option(
            help="Run only this part: kills, beginnings, log, disk, bits or strangers; on a cluster: nodes, stopped, "
            "full, head (requires redis-server), kills, beginnings, log or bits. May be repeated."
        ),
    ] = None,
    placement: Annotated[
        str, typer.Option(help="`local`, or `ray` for a Ray cluster of three nodes on this machine.")
    ] = "local",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random moments and places.")] = 0,
    work: Annotated[Path, typer.Option(help="Folder for data folders and logs; its contents are deleted.")] = Path(
        "out/faults"
    ),
    out: Page = None,
    changes: Changes = None,
) -> None:
    """Kills the service and its workers, damages files and fills the disk, and compares with an undisturbed run.

    Then clients without a token attack the service during updates, with an endless header, half-sent headers and
    stalled uploads.

    Example: scripts/bench faults samples/robot --set static.iterations=300 --set update.iterations=20
    """
    from client.cli.changes import parse_changes
    from client.cli.extras import need_server
    from client.importers.open_source import open_source
    from studies.cluster import faults as of_nodes
    from studies.running.outcome import ScenarioResult, table
    from studies.running.study import Study, encoded_frames
    from studies.service import faults as of_faults

    need_server()
    if placement not in ("local", "ray"):
        raise typer.BadParameter(f"unknown placement {placement!r}; choose from local, ray", param_hint="--placement")
    known = (
        of_faults.PARTS if placement == "local" else (*of_nodes.ON_NODES, of_nodes.OF_THE_HEAD, *of_nodes.AS_LOCALLY)
    )
    if unknown := set(part or []) - set(known):
        raise typer.BadParameter(f"unknown part {sorted(unknown)[0]!r}; choose from {', '.join(known)}")
    opened = open_source(capture)
    study = Study(
        work.resolve(),
        opened,
        encoded_frames(opened, frames),
        parse_changes(changes),
        {},
    )

    def run(study: Study, parts: Sequence[str]) -> list[ScenarioResult]:
        return of_faults.run(
            study,
            moments=kills,
            cuts=cuts,
            flips=flips,
            bits=bits,
            seed=seed,
            turns=turns,
            parts=parts,
            echo=typer.echo,
        )

    if placement == "local":
        outcomes = run(study, part or known)
    else:
        outcomes = of_nodes.run(study, count=kills, seed=seed, parts=part or known, local=run, echo=typer.echo)
    text = table(outcomes)
    typer.echo(text)
    write_page(out, text)
    if not all(outcome.reached for outcome in outcomes):
        raise typer.Exit(1)


def ingest(
    frames: Annotated[int, typer.Option(min=1, help="Number of frames per round.")] = 20,
    cameras: Annotated[int, typer.Option(min=1, help="Number of cameras in the rig.")] = 27,
    megabytes: Annotated[float, typer.Option(min=0.01, help="Size of one JPEG.")] = 1.0,
    rounds: Annotated[int, typer.Option(min=1, help="Number of rounds; each measures every transport.")] = 5,
    senders: Annotated[int, typer.Option(min=1, help="Number of connections of the sending process.")] = 2,
    work: Annotated[Path, typer.Option(help="Folder on the disk to measure.")] = Path("out/ingest"),
    out: Page = None,
) -> None:
    """Compares the ingest rate over the loopback interface with that of plain fsynced writes of the same records."""
    from client.cli.extras import need_server
    from studies.service import ingest as of_ingest

    need_server()

    size = int(megabytes * 1e6)
    measured = of_ingest.measure(
        work.resolve(), frames=frames, cameras=cameras, size_bytes=size, rounds=rounds, senders=senders
    )
    text = of_ingest.page(measured, frames=frames, cameras=cameras, size_bytes=size, senders=senders)
    typer.echo(text)
    write_page(out, text)


def views(
    capture: Repeated,
    rate: Annotated[
        list[float] | None, typer.Option(min=0.1, help="Views per second; default: 1, 5 and 20. May be repeated.")
    ] = None,
    updates: Annotated[int, typer.Option(min=1, help="Number of updates per turn, without and with views.")] = 8,
    turns: Annotated[int, typer.Option(min=1, help="Number of turns per rate.")] = 3,
    width: Annotated[int, typer.Option(min=1, help="Width of a view in pixels.")] = 256,
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
        rates=rate or (1, 5, 20),
        updates=updates,
        turns=turns,
        width=width,
        settings=parse_changes(changes),
        environment={},
        echo=typer.echo,
    )
    text = of_views.page(rows, capture.name, width, updates, turns)
    typer.echo(text)
    write_page(out, text)


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


def sleeping(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene folder, DATA/scenes/ID.")],
    count: Annotated[int, typer.Option(min=1, help="Number of sleeping scenes.")] = 500,
    views: Annotated[int, typer.Option(min=1, help="Number of scenes to wake with a view.")] = 5,
    work: Annotated[Path, typer.Option(help="Data folder of the copies; its contents are deleted.")] = Path(
        "out/sleeping"
    ),
) -> None:
    """Measures the memory, listing time and first views of sleeping scenes, and prints the result as JSON.

    The scenes are copies of one scene.
    """
    import json

    from client.cli.extras import need_server
    from studies.service import memory as of

    need_server()
    typer.echo(json.dumps(of.sleeping(scene, count, min(views, count), work.resolve())))
