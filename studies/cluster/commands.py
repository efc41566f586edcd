"""The commands `scripts/bench cluster` and `scripts/bench head`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from studies.options import Changes, Page, Repeated, write_page


def cluster(
    capture: Repeated,
    frames: Annotated[int, typer.Option(min=3, help="Frames per scene.")] = 12,
    scenes: Annotated[int, typer.Option(min=1, help="Number of concurrent scenes on the three nodes.")] = 6,
    turns: Annotated[int, typer.Option(min=1, help="Repetitions of each placement.")] = 3,
    views: Annotated[int, typer.Option(min=1, help="Number of views of an idle scene rendered per turn.")] = 60,
    work: Annotated[Path, typer.Option(help="Folder for the services' data; its contents are deleted.")] = Path(
        "out/cluster"
    ),
    out: Page = None,
    changes: Changes = None,
) -> None:
    """Measures how much a three-node Ray cluster on this machine slows updates and views, relative to local processes.

    Example: scripts/bench cluster samples/robot --set static.iterations=300 --set update.iterations=20
    """
    from client.cli.changes import parse_changes
    from client.cli.extras import need_server
    from client.importers.open_source import open_source
    from studies.cluster.cost import measure, summarize
    from studies.cluster.nodes import Nodes
    from studies.running.study import Study, encoded_frames

    need_server()
    opened = open_source(capture)
    study = Study(work.resolve(), opened, encoded_frames(opened, frames), parse_changes(changes), {})
    with Nodes(count=3, cpus=3) as nodes:
        figures = measure(study, nodes.address, scenes=scenes, turns=turns, views=views, echo=typer.echo)
    text = summarize(figures, scenes)
    typer.echo(text)
    write_page(out, text)


def head(
    times: Annotated[int, typer.Option(min=1, help="Number of times the head is killed.")] = 20,
    out: Page = None,
) -> None:
    """Measures how long a Ray cluster cannot place work after its head is killed and immediately restarted, with Redis.

    Example: scripts/bench head --times 20
    """
    from studies.cluster.silence import silences, summarize

    text = summarize(silences(times, typer.echo))
    typer.echo(text)
    write_page(out, text)
