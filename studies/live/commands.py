"""The commands `scripts/bench live`, `soak`, `viewer` and `drawing`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from studies.options import Page, Repeated, write_page


def live(
    capture: Repeated,
    cameras: Annotated[
        int, typer.Option(min=1, help="Number of cameras; the first ones of the capture, and copies if it has fewer.")
    ] = 24,
    frames: Annotated[int, typer.Option(min=10, help="Number of frames for each of the two measurements.")] = 200,
    work: Annotated[Path, typer.Option(help="Folder for the data folder and log; its contents are deleted.")] = Path(
        "out/live"
    ),
    out: Page = None,
) -> None:
    """Measures the frame rate and latency of the service with an engine whose iterations take no time.

    Example: scripts/bench live samples/robot --cameras 18
    """
    from client.cli.extras import need_server
    from client.importers.open_source import open_source
    from studies.live.live import report, rig_with, run

    need_server()
    source = open_source(capture)
    rig = rig_with(source, cameras)
    text = report(rig, run(source, rig, frames, work))
    typer.echo(text)
    write_page(out, text)


def soak(
    capture: Repeated,
    cameras: Annotated[int, typer.Option(min=1, help="Number of cameras; the first ones of the capture.")] = 4,
    scale: Annotated[float, typer.Option(min=0.01, max=1, help="Scale of the images.")] = 0.25,
    frames: Annotated[int, typer.Option(min=100, help="Number of frames.")] = 20_000,
    work: Annotated[Path, typer.Option(help="Folder for data folder, rows and log; its contents are deleted.")] = Path(
        "out/soak"
    ),
    out: Page = None,
) -> None:
    """Sends thousands of frames at full rate, and checks that the memory of service and worker does not grow.

    The updates run on an engine whose iterations take no time. Fails if memory grows by more than 2%.

    Example: scripts/bench soak samples/robot
    """
    from client.cli.extras import need_server
    from client.importers.open_source import open_source
    from scas4d_core.cameras import Rig
    from studies.live.soak import TARGET, growth, report, run

    need_server()
    source = open_source(capture)
    rig = Rig(source.full_rig.cameras[:cameras]).scaled(scale)
    rows = run(
        source,
        rig,
        frames,
        work,
        echo=lambda row: typer.echo(f"frame {row.frame}: service {row.service:.1f} MB, worker {row.worker:.1f} MB"),
    )
    text = report(rig, rows)
    typer.echo(text)
    write_page(out, text)
    if growth(rows) > TARGET:
        raise typer.Exit(1)


def viewer(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Output folder of `scas4d reconstruct`.")],
    frames: Annotated[int, typer.Option(min=10, help="Number of frames.")] = 60,
    fps: Annotated[float, typer.Option(min=0.1, help="Frames per second.")] = 5.0,
    work: Annotated[Path, typer.Option(help="Folder for the data folder and log; its contents are deleted.")] = Path(
        "out/viewer"
    ),
    out: Page = None,
) -> None:
    """Measures the bytes of a live frame, and the time from its commit to its picture, in a browser.

    Example: scripts/bench viewer out/reconstruct
    """
    from client.cli.extras import need_server
    from studies.live.viewer import report, run

    need_server()
    text = report(run(folder, frames, fps, work), fps)
    typer.echo(text)
    write_page(out, text)


def drawing(
    folders: Annotated[list[Path], typer.Argument(metavar="FOLDER...", help="Output folders of `scas4d reconstruct`.")],
    against: Annotated[
        Path | None, typer.Option(help="Folder server/viewer of another version, measured in turns.")
    ] = None,
    count: Annotated[list[int] | None, typer.Option(min=1, help="Number of Gaussians. May be repeated.")] = None,
    turns: Annotated[int, typer.Option(min=1, help="Number of measurements of each version.")] = 3,
    seconds: Annotated[float, typer.Option(min=1, help="Duration of a measurement.")] = 4.0,
    work: Annotated[Path, typer.Option(help="Folder for scenes; its files are overwritten.")] = Path("out/drawing"),
    out: Page = None,
) -> None:
    """Measures how fast the viewer draws in a browser, and how closely its pictures match the CPU renderer's.

    Example: scripts/bench drawing out/robot out/stage --against ../before/server/viewer
    """
    from studies.live.drawing import run

    text = run(folders, against, count or [22_000, 94_000, 500_000], turns, seconds, work)
    typer.echo(text)
    write_page(out, text)
