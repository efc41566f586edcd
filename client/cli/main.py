"""The `scas4d` command line. Subcommands that need the core or the server import it lazily."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from client import __version__
from client.cli import commands, extras, scenes, viewing
from client.cli.capture_options import open_capture, with_capture_options
from client.cli.changes import Changes, Preset, parse_changes
from client.errors import ServiceError, ServiceUnreachable
from client.importers.open_source import CaptureOptions
from client.progress import console
from client.sdk import DEFAULT_URL
from scas4d_core.captures import CaptureError, ImageError

app = typer.Typer(no_args_is_help=True, add_completion=False, help="Online 4D reconstruction from multi-camera rigs.")
commands.register(app)
viewing.register(app)

CaptureFolder = Annotated[Path, typer.Argument(metavar="CAPTURE", help="Capture folder.")]
Frames = Annotated[int | None, typer.Option(min=1, help="Maximum number of frames.")]
Out = Annotated[Path, typer.Option(help="Output folder.")]


@app.command()
def serve(
    host: Annotated[
        str | None, typer.Option(help="Address to listen on; non-loopback addresses require a token (SCAS4D_TOKEN).")
    ] = None,
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="Port; default: the configured port, or 8000.")
    ] = None,
    data: Annotated[Path | None, typer.Option(help="Data folder; default: the configured one, or ./data.")] = None,
    placement: Annotated[
        str | None,
        typer.Option(help="`local`, or `ray[=HOST:PORT]` to run scenes on a Ray cluster (see docs/cluster.md)."),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(help=("TOML settings file; see docs/service-settings.md. Environment variables take precedence.")),
    ] = None,
) -> None:
    """Starts the service. Settings not given here are read from the environment (SCAS4D_...), then from the file."""
    if config is not None:
        os.environ["SCAS4D_CONFIG"] = str(config)
    from server.serve import serve as run
    from server.settings import ServerSettings

    run(ServerSettings.from_environment(host=host, port=port, data=data, placement=placement))


@app.command()
def doctor(
    data: Annotated[Path, typer.Option(help="The service's data folder.")] = Path("data"),
) -> None:
    """Checks this machine: packages, disk and GPU. Reports what is missing and how to install it."""
    from client.cli.doctor import run as check

    raise typer.Exit(check(data))


@app.command()
@with_capture_options
def demo(
    options: CaptureOptions,
    capture: Annotated[Path, typer.Option(help="Folder of a capture.")] = Path("samples/robot"),
    out: Out = Path("out/demo"),
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port; if it is taken, a free port is used.")] = 8000,
    stay: Annotated[
        bool | None,
        typer.Option(help="Keep the service running until Ctrl-C; default: only in a terminal."),
    ] = None,
    frames: Frames = None,
    preset: Preset = "scas4d",
    changes: Changes = None,
) -> None:
    """Starts a service, streams the sample capture through it, and saves renders next to the ground-truth images."""
    from client.cli import demo as main_job

    given, settings = open_capture(capture, options), parse_changes(changes)
    stays = sys.stdout.isatty() if stay is None else stay
    data, log = out / "data", out / "service.log"
    with main_job.running_service(data, log, port) as url:
        console.print(f"service at {url}, log at {log}", soft_wrap=True)
        id = main_job.run(given, url, out, frames=frames, preset=preset, settings=settings)
        console.print(f"images (truth | render | difference x4): {out}", soft_wrap=True)
        if stays:
            console.print(
                f"open {url}/#scene={id}&tour for a short tour (documentation: {url}/docs); Ctrl-C stops the service",
                soft_wrap=True,
            )
            try:
                while True:
                    time.sleep(3600)
            except KeyboardInterrupt:
                console.print("stopping the service")
    console.print("the service has stopped (use --stay to keep it running); to view the scene:", soft_wrap=True)
    console.print(f"scas4d serve --data {data}, then open {DEFAULT_URL}/#scene={id}", highlight=False, soft_wrap=True)


@app.command()
@with_capture_options
def reconstruct(
    capture: CaptureFolder,
    options: CaptureOptions,
    out: Out = Path("out/reconstruct"),
    frames: Frames = None,
    preset: Preset = "scas4d",
    videos: Annotated[bool, typer.Option("--videos", help="Also write an MP4 file per camera.")] = False,
    changes: Changes = None,
) -> None:
    """Reconstructs a capture in this process, without a service; writes images, states and a .ply of the last frame."""
    from client.cli.reconstruct import reconstruct as run

    given = parse_changes(changes)
    run(open_capture(capture, options), out, frames=frames, preset=preset, changes=given, videos=videos)


@app.command()
@with_capture_options
def evaluate(
    capture: CaptureFolder,
    options: CaptureOptions,
    out: Out = Path("out/evaluate"),
    frames: Frames = None,
    preset: Preset = "scas4d",
    changes: Changes = None,
    again: Annotated[
        bool, typer.Option("--again", help="Measure again even if --out already contains the scores.")
    ] = False,
    states: Annotated[
        Path | None,
        typer.Option(
            help="Score existing states instead of reconstructing: a .s4d file, USD, or numbered .glb files. Use the "
            "same --set scene.image_scale=... as for the reconstruction."
        ),
    ] = None,
    rate: Annotated[
        float | None, typer.Option("--source-fps", help="Frame rate of numbered files in --states. [30]")
    ] = None,
) -> None:
    """Prints a capture's scores on its test cameras and ground truth. Reconstructs it first if --out has no scores yet.

    Without test cameras (use --test to hold some out), training cameras are scored and the table is marked accordingly.
    """
    if states is not None:
        from client.cli.evaluate_states import evaluate_states, scale_of

        scale = scale_of(parse_changes(changes))
        evaluate_states(states, capture, out, options=options, frames=frames, rate=rate, image_scale=scale)
        return
    from client.cli.evaluate import evaluate as run

    given = parse_changes(changes)
    run(capture, out, options=options, frames=frames, preset_name=preset, changes=given, again=again)


@app.command()
def export(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            help=(
                "A compact file (.s4d), an output folder of `scas4d reconstruct`, a scene id, or an export "
                "with ids: USD, or numbered .glb files in a folder or .zip."
            ),
        ),
    ],
    format: Annotated[
        str | None,
        typer.Option(
            help="ply, splat, spz, spz4, glb, glb-parts, usd, tracks, poses, tapvid-mv or s4d; see docs/exports.md."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Output file; a folder or .zip if the format has one file per frame. [named after SOURCE]"),
    ] = None,
    player: Annotated[
        Path | None, typer.Option(metavar="OUT.html", help="Write a self-contained page that plays the frames offline.")
    ] = None,
    frames: Annotated[str | None, typer.Option(metavar="A:B", help="First and last frame, inclusive.")] = None,
    ids: Annotated[
        list[int] | None,
        typer.Option("--id", help="Export only this Gaussian (tracks and tapvid-mv). May be repeated."),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option("--source-fps", help="Frame rate of numbered files, which have no timestamps. [30]"),
    ] = None,
    url: scenes.Url = DEFAULT_URL,
    token: scenes.Token = None,
) -> None:
    """Exports reconstructed frames to other formats (splats, glTF, USD, tables) or to an offline player page.

    Example: scas4d reconstruct samples/robot --out out/robot; scas4d export out/robot --player robot.html
    """
    if player is not None:
        if format is not None or out is not None or ids:
            raise typer.BadParameter("--player cannot be combined with --format, --out or --id; omit them")
        from client.exports.player import export_player

        return export_player(source, player, frames, url=url, token=token)
    if format is None:
        raise typer.BadParameter("specify --format, or --player OUT.html")
    from client.exports.export import export as run

    run(source, format, out, frames, ids, rate, url=url, token=token)


def _version(wanted: bool) -> None:
    if wanted:
        console.print(__version__)
        raise typer.Exit


@app.callback()
def options(version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True)] = False) -> None:
    """Handles the options that precede a command."""


def main() -> None:
    """Runs the `scas4d` command line."""
    run(app, "scas4d", extras.install_hint)


def run(commands: typer.Typer, name: str, remedy: Callable[[ModuleNotFoundError], str | None]) -> None:
    """Runs a command line and reports errors that the user can fix as one line instead of a traceback.

    Args:
        commands: Typer app to run.
        name: command name as typed by the user.
        remedy: callback that returns an installation hint for a missing module, or None if there is none.
    """
    try:
        commands(prog_name=name)
    except ModuleNotFoundError as error:
        install = remedy(error)
        if install is None:
            raise
        raise SystemExit(f"{name}: {install}") from None
    except ServiceUnreachable as error:
        hint = "; start a service with: scas4d serve" if error.refused else ""
        raise SystemExit(f"{name}: {error}{hint}") from None
    except (ServiceError, CaptureError, ImageError, RuntimeError, ValueError, OSError) as error:
        raise SystemExit(f"{name}: {error}") from None


if __name__ == "__main__":
    main()
