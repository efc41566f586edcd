"""Commands that visualize states: `scas4d video` and `scas4d rerun`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from client.cli import scenes
from client.cli.capture_options import print_remarks, with_capture_options
from client.importers.open_source import CaptureOptions
from client.sdk import DEFAULT_URL

Source = Annotated[
    str,
    typer.Argument(
        metavar="SOURCE", help="A compact file (.s4d), an output folder of `scas4d reconstruct`, or a scene id."
    ),
]
Frames = Annotated[str | None, typer.Option(metavar="A:B", help="First and last frame, inclusive.")]


@with_capture_options
def video(
    source: Source,
    options: CaptureOptions,
    out: Annotated[
        Path | None, typer.Option(help="Output file (.mp4 or .webp); default: an MP4 next to SOURCE.")
    ] = None,
    path: Annotated[
        str,
        typer.Option(
            help="Camera path: orbit, camera, or a JSON file of key poses; see docs/videos.md.", metavar="PATH"
        ),
    ] = "orbit",
    camera: Annotated[
        str | None,
        typer.Option(help="Camera to render from, or at which the orbit starts; default: the first.", metavar="CAMERA"),
    ] = None,
    frames: Frames = None,
    fps: Annotated[float | None, typer.Option(min=0.1, max=240, help="Video frame rate; default: the scene's.")] = None,
    speed: Annotated[
        float,
        typer.Option(min=0.001, max=1000, help="Seconds of the scene per second of video; 0.25 is slow motion."),
    ] = 1.0,
    seconds: Annotated[
        float | None,
        typer.Option(
            min=0.01, max=86400, help="Duration in seconds; the last frame is held. Default: the duration of the scene."
        ),
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(metavar="WxH", help="Render size, such as 1280x720; default: the camera's."),
    ] = None,
    orbit_speed: Annotated[
        float, typer.Option(min=-3600, max=3600, help="Orbit speed in degrees per second; negative values turn left.")
    ] = 30.0,
    interpolate: Annotated[
        bool, typer.Option("--interpolate", help="Interpolate between frames; default: show the nearest frame.")
    ] = False,
    tracks: Annotated[int, typer.Option(min=0, max=1000, help="Draw the trails of this many moving points.")] = 0,
    trail: Annotated[
        float, typer.Option(min=0.01, max=600, help="Seconds of video after which a trail fades out.")
    ] = 1.0,
    parts: Annotated[bool, typer.Option("--parts", help="Colour Gaussians by part.")] = False,
    compare: Annotated[
        Path | None, typer.Option(metavar="CAPTURE", help="Show the ground-truth image from this capture on the right.")
    ] = None,
    background: Annotated[
        str | None, typer.Option(help="Background colour, such as white or #202020; default: the scene's.")
    ] = None,
    url: scenes.Url = DEFAULT_URL,
    token: scenes.Token = None,
) -> None:
    """Renders frames to a video from a camera that orbits, stays fixed or follows key poses.

    Example: scas4d reconstruct samples/robot --out out/robot; scas4d video out/robot --speed 0.25 --interpolate
    """
    from client.exports.video.shot import VideoOptions
    from client.exports.video.video import background_colour, make_video, picture_size

    wanted = VideoOptions(
        path=path,
        camera=camera,
        orbit_speed=orbit_speed,
        fps=fps,
        speed=speed,
        seconds=seconds,
        size=None if size is None else picture_size(size),
        interpolate=interpolate,
        tracks=tracks,
        trail=trail,
        parts=parts,
        background=None if background is None else background_colour(background),
    )
    capture = None if compare is None else options.open(compare)
    if capture is not None:
        print_remarks(capture)
    make_video(source, out, wanted, frames=frames, compared=capture, url=url, token=token)


def rerun(
    source: Source,
    out: Annotated[
        Path | None, typer.Option(help="Output file (.rrd); default: next to SOURCE, with the same name.")
    ] = None,
    frames: Frames = None,
    tracks: Annotated[int, typer.Option(min=0, max=10_000, help="Number of moving points to draw trails for.")] = 30,
    trail: Annotated[float, typer.Option(min=0, help="Trail length in seconds of scene time.")] = 0.5,
    parts: Annotated[bool, typer.Option("--parts", help="Colour points by part.")] = False,
    url: scenes.Url = DEFAULT_URL,
    token: scenes.Token = None,
) -> None:
    """Writes frames as a recording for the Rerun viewer (extra `rerun`): points, tracks, the rig and parts.

    Example: scas4d reconstruct samples/robot --out out/robot; scas4d rerun out/robot; rerun out/robot/states.rrd
    """
    from client.exports.recording import make_recording

    make_recording(source, out, frames=frames, tracks=tracks, trail=trail, parts=parts, url=url, token=token)


def register(app: typer.Typer) -> None:
    """Adds this module's commands to the app."""
    app.command()(video)
    app.command()(rerun)
