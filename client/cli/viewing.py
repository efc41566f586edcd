"""Commands that make something to look at of states: `scas4d video` and `scas4d rerun`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from client.cli import commands
from client.cli.capture_options import print_remarks, takes_capture
from client.importers.open_source import CaptureOptions
from client.sdk import DEFAULT_URL

Source = Annotated[
    str,
    typer.Argument(
        metavar="SOURCE", help="A compact file (.s4d), the folder of `scas4d reconstruct`, or a scene's id."
    ),
]
Frames = Annotated[str | None, typer.Option(metavar="A:B", help="Only these frames, both ends counted in.")]


@takes_capture
def video(
    source: Source,
    options: CaptureOptions,
    out: Annotated[Path | None, typer.Option(help="File, .mp4 or .webp; without it an MP4 beside SOURCE.")] = None,
    path: Annotated[
        str, typer.Option(help="orbit, camera, or a JSON file of key poses; docs/videos.md.", metavar="PATH")
    ] = "orbit",
    camera: Annotated[
        str | None,
        typer.Option(help="Camera to look through, or where the orbit begins; the first without it.", metavar="CAMERA"),
    ] = None,
    frames: Frames = None,
    fps: Annotated[
        float | None, typer.Option(min=0.1, max=240, help="Pictures a second; those of the frames without it.")
    ] = None,
    speed: Annotated[
        float,
        typer.Option(min=0.001, max=1000, help="Seconds of the scene in a second of the video; 0.25: slow motion."),
    ] = 1.0,
    seconds: Annotated[
        float | None,
        typer.Option(min=0.01, max=86400, help="Length; the last frame stays. Without it until the frames end."),
    ] = None,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Size of the render, as 1280x720; the camera's without it.")
    ] = None,
    turn: Annotated[
        float, typer.Option(min=-3600, max=3600, help="Degrees a second of the orbit; negative: to the left.")
    ] = 30.0,
    between: Annotated[
        bool, typer.Option("--between", help="Interpolate between frames; without it the nearest is shown.")
    ] = False,
    tracks: Annotated[int, typer.Option(min=0, max=1000, help="Draw the trails of so many points that move.")] = 0,
    trail: Annotated[
        float, typer.Option(min=0.01, max=600, help="Seconds of the video until a trail has faded.")
    ] = 1.0,
    parts: Annotated[bool, typer.Option("--parts", help="Colour by part.")] = False,
    beside: Annotated[
        Path | None, typer.Option(metavar="CAPTURE", help="Put the camera's true picture of this capture beside.")
    ] = None,
    background: Annotated[
        str | None, typer.Option(help="Colour behind everything, as white or #202020; the scene's without it.")
    ] = None,
    url: commands.Url = DEFAULT_URL,
    token: commands.Token = None,
) -> None:
    """Renders frames as a video from a camera that circles, stands or follows key poses.

    Example: scas4d reconstruct samples/robot --out out/robot; scas4d video out/robot --speed 0.25 --between
    """
    from client.exports.video.shot import VideoOptions
    from client.exports.video.video import background_colour, make_video, picture_size

    wanted = VideoOptions(
        path=path,
        camera=camera,
        turn=turn,
        fps=fps,
        speed=speed,
        seconds=seconds,
        size=None if size is None else picture_size(size),
        between=between,
        tracks=tracks,
        trail=trail,
        parts=parts,
        background=None if background is None else background_colour(background),
    )
    capture = None if beside is None else options.open(beside)
    if capture is not None:
        print_remarks(capture)
    make_video(source, out, wanted, frames=frames, beside=capture, url=url, token=token)


def rerun(
    source: Source,
    out: Annotated[Path | None, typer.Option(help="File, .rrd; without it beside SOURCE, named after it.")] = None,
    frames: Frames = None,
    tracks: Annotated[int, typer.Option(min=0, max=10_000, help="Ways of so many points that move.")] = 30,
    trail: Annotated[float, typer.Option(min=0, help="Length of these ways, seconds of the scene.")] = 0.5,
    parts: Annotated[bool, typer.Option("--parts", help="Colour by part.")] = False,
    url: commands.Url = DEFAULT_URL,
    token: commands.Token = None,
) -> None:
    """Writes frames as a recording for the Rerun viewer (extra `rerun`): points, tracks, the rig, parts.

    Example: scas4d reconstruct samples/robot --out out/robot; scas4d rerun out/robot; rerun out/robot/states.rrd
    """
    from client.exports.recording import make_recording

    make_recording(source, out, frames=frames, tracks=tracks, trail=trail, parts=parts, url=url, token=token)


def register(app: typer.Typer) -> None:
    """Adds these commands."""
    app.command()(video)
    app.command()(rerun)
