"""The commands `scripts/bench live`, `viewer` and `drawing`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from studies.options import Page, Repeated, show


def live(
    capture: Repeated,
    cameras: Annotated[int, typer.Option(min=1, help="Number of cameras; the first ones of the capture.")] = 24,
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
    from scas4d_core.cameras import Rig
    from studies.live.live import report, run

    need_server()
    source = open_source(capture)
    rig = Rig(source.full_rig.cameras[:cameras])
    text = report(rig, run(source, rig, frames, work))
    show(text, out)


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
    show(text, out)


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
    show(text, out)
