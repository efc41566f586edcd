"""Commands that talk to a service or prepare captures for it: `scas4d push`, `scenes`, `watch`, `begin-again`, etc."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import typer

from client import rig
from client.cli import scenes
from client.cli.capture_options import finish, note, open_capture, with_capture_options
from client.cli.changes import Changes, Labels, Preset, parse_changes, parse_labels
from client.cli.scenes import Scene, Token, Url
from client.importers.open_source import CaptureOptions
from client.importers.source import Encoding
from client.progress import Bars, console
from client.sdk import DEFAULT_URL, Client
from client.wire import FINISHED, FrameReportModel, IngestSettings
from scas4d_core.captures import InitialPoints
from scas4d_core.frame_outcome import AlarmKind

PUSH_OUTAGE_S = 600.0
"""How long a rig keeps retrying, in seconds; long enough to survive a restart of the service."""


CaptureFolder = Annotated[Path, typer.Argument(metavar="CAPTURE", help="Capture folder; see docs/captures.md.")]
Encode = Annotated[
    Encoding, typer.Option(help="Encoding of undistorted images and video frames; jpeg uses quality 95.")
]


@with_capture_options
def push(
    capture: CaptureFolder,
    options: CaptureOptions,
    url: Url = DEFAULT_URL,
    token: Token = None,
    scene: Annotated[
        str | None, typer.Option(help="Continue this scene from its next frame; default: create a new scene.")
    ] = None,
    fps: Annotated[
        float | None,
        typer.Option(
            min=0.001,
            help="Rate at which to send frames, to simulate a live rig; default: as fast as the service accepts them.",
        ),
    ] = None,
    frames: Annotated[int | None, typer.Option(min=1, help="Stop once the scene has this many frames.")] = None,
    start: Annotated[int, typer.Option(min=0, help="First frame of the capture to send.")] = 0,
    loop: Annotated[
        bool,
        typer.Option("--loop", help="Play the capture back and forth until --frames is reached or Ctrl-C is pressed."),
    ] = False,
    jitter: Annotated[float, typer.Option(min=0, help="Delay each frame by up to this many seconds.")] = 0.0,
    drop: Annotated[float, typer.Option(min=0, max=0.99, help="Fraction of frames to drop.")] = 0.0,
    seed: Annotated[int, typer.Option(help="Random seed for jitter and dropped frames.")] = 0,
    per_camera: Annotated[
        bool,
        typer.Option("--per-camera", help="Send each camera's images separately; --drop then drops individual images."),
    ] = False,
    websocket: Annotated[
        bool, typer.Option("--websocket", help="Send over a WebSocket instead of HTTP requests.")
    ] = False,
    batch: Annotated[
        int, typer.Option(min=1, max=100, help="Send up to this many frames in one request; not with --per-camera.")
    ] = 1,
    when_full: Annotated[
        Literal["refuse", "skip"],
        typer.Option(help="refuse: wait while the queue is full; skip: replace the queued frames with the newest."),
    ] = "refuse",
    outage: Annotated[
        float, typer.Option(min=0, help="Seconds to keep retrying while the service is unreachable.")
    ] = PUSH_OUTAGE_S,
    encoding: Encode = "jpeg",
    preset: Preset = "scas4d",
    changes: Changes = None,
    nodes: Labels = None,
) -> None:
    """Sends a capture to a running service as a live rig would, and waits until the last frame is finished."""
    settings, labels = parse_changes(changes), parse_labels(nodes)
    if labels and scene is not None:
        raise ValueError("--node applies only to new scenes and cannot be combined with --scene; omit one of them")
    source = open_capture(capture, options, encoding=encoding)
    with Client(url, token=token, outage=0) as client:
        client.live()  # a wrong address fails immediately; only later outages are retried
    with Client(url, token=token, outage=outage) as client, Bars() as bars:
        delivery = rig.push(
            source,
            client,
            scene=scene,
            pace=rig.Pace(fps, jitter, drop, seed),
            frames=frames,
            start=start,
            loop=loop,
            per_camera=per_camera,
            websocket=websocket,
            batch=batch,
            preset=preset,
            settings=settings,
            ingest=IngestSettings(when_full=when_full),
            nodes=labels,
            on_progress=bars,
            on_message=note,
        )
        status = client.scene(delivery.scene)
        only_left_out = delivery.left_out.images > 0 and status.lost_cameras
    console.print(delivery.lateness.summary(fps), highlight=False, soft_wrap=True)
    for sentence in status.warnings:
        if sentence not in source.remarks:  # already printed when the capture was opened
            console.print(sentence, style="yellow", highlight=False)
    console.print(f"scene {status.id}: {status.committed} of {status.next_frame} frames committed, {status.state}")
    console.print(f"{url.rstrip('/')}/#scene={status.id}", soft_wrap=True)
    if status.error and not only_left_out:
        raise SystemExit(f"scas4d: {status.error}")
    finish(delivery.left_out)


def watch(scene: Scene, url: Url = DEFAULT_URL, token: Token = None) -> None:
    """Prints a line for each finished frame of a scene, until Ctrl-C is pressed or the scene is deleted."""
    from client.stream import Stream, finished_frames, scene_changes
    from client.wire.stream import FrameMessage, SceneMessage

    state: str | None = None
    off = set[str]()
    with Client(url, token=token, outage=0) as client:
        client.scene(scene)  # a wrong id fails immediately
    try:
        with Stream(url, scene, token=token) as stream:
            stream.subscribe("frames", finished_frames())
            stream.subscribe("scene", scene_changes())
            for event in stream:
                if isinstance(event, FrameMessage) and event.report.state in FINISHED:
                    console.print(frame_line(event.report, event.missed, off), highlight=False, soft_wrap=True)
                    off |= out_of_step(event.report)  # report each only once
                elif isinstance(event, SceneMessage) and event.status.state != state:
                    state = event.status.state
                    console.print(f"scene is {state}" + (f": {event.status.error}" if event.status.error else ""))
    except KeyboardInterrupt:
        return


def budget(
    scene: Scene,
    iterations: Annotated[int | None, typer.Option(min=1, help="Iterations per frame.")] = None,
    milliseconds: Annotated[
        float | None,
        typer.Option(
            min=0.001,
            help="Time budget per frame in ms, until the new state is in memory; runs as many iterations as fit.",
        ),
    ] = None,
    keep_up: Annotated[
        float | None,
        typer.Option(min=0.001, max=1000, help="Frames per second to keep up with; excludes --milliseconds."),
    ] = None,
    stop_gain: Annotated[
        float | None,
        typer.Option(
            min=0, max=0.999, help="End an update once ten iterations lower its error by less than this fraction."
        ),
    ] = None,
    skip_tolerance: Annotated[
        float | None,
        typer.Option(
            min=-1,
            help="Skip the update if the previous state's error is at most (1 + this value) × the usual error.",
        ),
    ] = None,
    reset: Annotated[bool, typer.Option("--reset", help="Reset the budget to the scene's settings.")] = False,
    url: Url = DEFAULT_URL,
    token: Token = None,
) -> None:
    """Prints the compute budget for a scene's updates; with options, changes it from the next frame on."""
    given = (iterations, milliseconds, keep_up, stop_gain, skip_tolerance)
    if reset and any(value is not None for value in given):
        raise ValueError("--reset cannot be combined with a budget; omit one of them")
    with Client(url, token=token, outage=0) as client:
        if reset or any(value is not None for value in given):
            budget_now = client.set_budget(
                scene,
                iterations=iterations,
                budget_ms=milliseconds,
                keep_up_fps=keep_up,
                stop_gain=stop_gain,
                skip_tolerance=skip_tolerance,
            )
        else:
            budget_now = client.budget(scene)
    now = budget_now.effective
    many = (
        f"{now.iterations} iterations"
        if now.budget_ms is None
        else f"as many iterations as fit in {now.budget_ms:g} ms"
    )
    if now.keep_up_fps is not None:
        many = f"as many iterations as {now.keep_up_fps:g} frames per second allow"
    stops = f", or fewer: stop gain {now.stop_gain:g}" if now.stop_gain else ""
    console.print(
        f"{many} per frame{stops}; skip tolerance {now.skip_tolerance:g}; from frame {budget_now.since} on",
        highlight=False,
    )


def begin_again(
    scene: Scene,
    frame: Annotated[
        int | None,
        typer.Option(
            min=0, help="First frame of the new reconstruction, already received or still to come; default: unchanged."
        ),
    ] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="NAME=VALUE", help="Change a setting, such as static.iterations=3000. May be repeated."
        ),
    ] = None,
    points: Annotated[
        Path | None,
        typer.Option(
            help=(
                "npz file with positions, colours and optionally foreground, or init_pt_cld.npz; default: the scene's "
                "points."
            )
        ),
    ] = None,
    no_points: Annotated[bool, typer.Option("--no-points", help="Start from the images alone.")] = False,
    discard: Annotated[bool, typer.Option("--discard", help="Discard the committed frames.")] = False,
    url: Url = DEFAULT_URL,
    token: Token = None,
) -> None:
    """Restarts the reconstruction of a scene, e.g. if its first frame failed or is of poor quality."""
    if points is not None and no_points:
        raise ValueError("--points and --no-points are mutually exclusive; use only one of them")
    settings = parse_changes(changes)
    with Client(url, token=token) as client:
        number = client.scene(scene).reconstruction + 1
        if points is not None:
            with np.load(points, allow_pickle=False) as file:
                given = {name: file[name] for name in ("positions", "colours", "foreground") if name in file}
                if not given and "data" in file and file["data"].shape[1:] in ((6,), (7,)):  # init_pt_cld.npz
                    columns = np.split(file["data"], (3, 6), axis=1)
                    given = {"positions": columns[0], "colours": columns[1].astype(np.float32)}
                    given |= {"foreground": columns[2][:, 0].astype(np.float32)} if columns[2].size else {}
            if missing := {"positions", "colours"} - given.keys():
                raise ValueError(
                    f"{points}: missing {' and '.join(sorted(missing))}; create it with numpy.savez(positions=…, "
                    "colours=…)"
                )
            client.put_points(scene, InitialPoints(**given), reconstruction=number)
        status = client.begin_again(
            scene, number, settings=settings, frame=frame, points=not no_points, discard=discard
        )
    console.print(
        f"scene {scene}: reconstruction {number} starts at frame {status.first_frame}; {status.queued} queued",
        highlight=False,
    )


@with_capture_options
def import_(
    capture: CaptureFolder,
    options: CaptureOptions,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="New folder for the undistorted capture.")],
    frames: Annotated[int | None, typer.Option(min=1, help="Maximum number of frames to import.")] = None,
    encoding: Encode = "jpeg",
) -> None:
    """Writes an undistorted copy of a capture, which can be read at the rig's frame rate without OpenCV and PyAV."""
    from client.importers.write import write_dynamic3dgs

    source = open_capture(capture, options, encoding=encoding)
    with Bars() as bars:
        left_out = write_dynamic3dgs(source, out, frames=frames, on_progress=bars, on_message=note)
    count = len(source.rig) + (0 if source.test_rig is None else len(source.test_rig))
    console.print(f"wrote {count} cameras to {out}; to send them: scas4d push {out}", highlight=False, soft_wrap=True)
    finish(left_out)


REPORT_LINE_PARTS = frozenset({AlarmKind.CAMERA_LEFT_OUT, AlarmKind.FRAME_REJECTED, AlarmKind.FRAME_IN_PART})
"""Alarms that other parts of a frame's output line already report."""


def out_of_step(report: FrameReportModel) -> set[str]:
    """Returns the names of the cameras that a frame report marks as out of step."""
    return {name for name, one in report.timing.items() if one.out_of_step}


def frame_line(report: FrameReportModel, missed: int = 0, off: Collection[str] = ()) -> str:
    """Formats the report of a finished frame as a single line.

    Args:
        report: report of a finished frame.
        missed: number of preceding frames that are not shown.
        off: cameras already reported as out of step, which are not reported again.
    """
    parts = [f"frame {report.index}: {report.state}"]
    if report.psnr is not None:
        parts.append(f"{report.psnr:.1f} dB")
    if "total" in report.seconds:
        parts.append(f"{report.seconds['total']:.2f} s")
    if report.degraded:
        parts.append(report.degraded)
    if report.dropped_cameras:
        parts.append(f"without {', '.join(report.dropped_cameras)}")
    for alarm in report.alarms:
        if alarm.kind not in REPORT_LINE_PARTS:
            parts.append(alarm.evidence if alarm.camera is None else f"camera {alarm.camera}: {alarm.evidence}")
    for name in sorted(out_of_step(report).difference(off)):
        parts.append(f"camera {name}: out of step by {report.timing[name].frames:+.2f} frames")
    if report.error:
        parts.append(report.error)
    if missed:
        parts.append(f"({missed} earlier not shown)")
    return "  ".join(parts)


def register(app: typer.Typer) -> None:
    """Adds this module's commands to the app."""
    app.command()(push)
    app.command(name="import")(import_)
    app.add_typer(scenes.app, name="scenes")
    app.command()(watch)
    app.command()(budget)
    app.command()(begin_again)
