"""The command `scripts/bench simulate`."""

from __future__ import annotations

from typing import Annotated

import typer

from studies.options import Page, write_page
from studies.simulation.delays import HEAD_S


def simulate(
    scenes: Annotated[int, typer.Option(min=8, help="Number of scenes, which fill 85% of the CPUs.")] = 5000,
    nodes: Annotated[int, typer.Option(min=3, help="Number of nodes.")] = 200,
    failures: Annotated[
        int, typer.Option(min=20, help="Number of failures of nodes, workers, service and head.")
    ] = 1000,
    frames: Annotated[int, typer.Option(min=2, help="Frames per scene.")] = 40,
    seed: Annotated[int, typer.Option(help="Seed of all random draws.")] = 0,
    silent: Annotated[
        tuple[float, float],
        typer.Option(help="Shortest and longest time without the cluster's head, in seconds."),
    ] = HEAD_S,
    out: Page = None,
) -> None:
    """Simulates a large cluster on a virtual clock, to check for lost or repeated frames and to time placement.

    The supervision of workers and the epochs of their folders are the service's own code. Ray, nodes and workers are
    models.

    Example: scripts/bench simulate --scenes 400 --nodes 16 --failures 200
    """
    from client.cli.extras import need_server

    need_server()
    from studies.simulation.simulate import Sizes
    from studies.simulation.simulate import simulate as run
    from studies.simulation.targets import rows, summarize

    outcome = run(Sizes(scenes, nodes, failures, frames, seed, silent))
    text = summarize(outcome)
    typer.echo(text)
    write_page(out, text)
    if not all(row.reached for row in rows(outcome)):
        raise typer.Exit(1)
