"""Implementation of `scas4d rerun`, which records points, tracks, the rig and parts for the Rerun viewer."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.exports.sources import Source, frame_range, opened
from client.exports.video.overlay import moving_rows
from client.exports.video.rig_view import RigView
from client.pictures import eight_bit
from client.progress import Bars, console
from client.wire import part_colour
from scas4d_core.cameras import Rig
from scas4d_core.errors import InputError
from scas4d_core.gaussians import Gaussians

SUFFIX = ".rrd"
FAINT = 0.1
"""Opacity below which Gaussians are omitted. Points are drawn opaque, so haze would hide the surfaces behind it."""
THIN = -0.7
"""Radius of the track lines. The viewer interprets negative radii as sizes in screen-space points."""
PLANE = 0.15
"""Distance of a camera's image plane in the viewer, as a fraction of the rig's radius."""


def make_recording(
    source: str,
    out: Path | None,
    *,
    frames: str | None = None,
    tracks: int = 30,
    trail: float = 0.5,
    parts: bool = False,
    url: str,
    token: str | None,
) -> Path:
    """Writes a Rerun recording, keeping only one state in memory at a time, and returns its path.

    Args:
        source: source of the states; see `opened`.
        out: path that ends in `.rrd`; None for a file next to the source, named after it.
        frames: inclusive range `A:B`; None for all frames.
        tracks: number of moving Gaussians whose trajectories are drawn.
        trail: trajectory length in seconds of scene time.
        parts: whether to colour points by part instead of using their own colours. Part labels are recorded in either
            case.
        url: service URL.
        token: access token for the service.

    Raises:
        InputError: if the range or output is invalid, or `parts` is set for a source without parts.
        ModuleNotFoundError: if rerun-sdk is not installed.
    """
    low, high = frame_range(frames)
    if out is not None and out.suffix.lower() != SUFFIX:
        raise InputError(f"out {str(out)!r} has the unsupported suffix {out.suffix!r}", f"use {SUFFIX}")
    with opened(source, low, high, parts, url, token) as given, Bars() as bars:
        if given.of.damage is not None:
            console.print(f"only part of the source can be read: {given.of.damage}", soft_wrap=True)
        times = given.within(low, high)
        target = out or given.beside / f"{given.name}{SUFFIX}"
        labels = given.parts()
        if parts and labels is None:
            raise InputError(
                f"parts: {given.name} contains no parts", "omit --parts; a scene without motion has no parts"
            )
        rows = moving_rows(given.some(list(times)), tracks)
        with _stream(target) as stream:
            _log_what_stays(stream, given, labels)
            ways: deque[tuple[float, NDArray[np.float64]]] = deque()
            for done, (index, seconds, state) in enumerate(given.states(low, high)):
                stream.set_time("frame", sequence=index)
                stream.set_time("seconds", duration=seconds)
                _log_points(stream, given, state, labels, by_part=parts)
                _log_tracks(stream, _longer(ways, given, state, rows, seconds, trail))
                bars("writing", done + 1, len(times))
    console.print(
        f"{target}: {len(times)} frames, {target.stat().st_size / 1e6:.1f} MB", highlight=False, soft_wrap=True
    )
    console.print(f"to view it: rerun {target}", highlight=False, soft_wrap=True)
    return target


@contextmanager
def _stream(target: Path) -> Iterator[Any]:
    """Yields a Rerun stream that records to a temporary file, and renames the file once it is complete."""
    import rerun
    from rerun import blueprint

    from scas4d_core.exports.atomic_files import atomic_path

    target.parent.mkdir(parents=True, exist_ok=True)
    look = blueprint.Blueprint(blueprint.Spatial3DView(origin="/world", name="scene"))
    with atomic_path(target) as beside:
        stream = rerun.RecordingStream("scas4d")
        stream.set_log_time_enabled(False)  # the time of recording is irrelevant
        stream.save(beside, default_blueprint=look)
        try:
            yield stream
        finally:
            stream.disconnect()


def _log_what_stays(stream: Any, given: Source, labels: NDArray[np.int64] | None) -> None:
    """Logs the static data: axes, part names and colours, and the rig.

    The class id of a part is its label + 1. Class 0 means no part.
    """
    import rerun

    rig = given.head.rig
    stream.log("world", _axes(rig), static=True)
    count = 0 if labels is None else int(labels.max(initial=-1)) + 1
    classes = [(0, "no part", (128, 128, 128))]
    classes += [(label + 1, f"part {label}", part_colour(label)) for label in range(count)]
    stream.log("world", rerun.AnnotationContext(classes), static=True)
    if rig is None:
        return
    plane = PLANE * RigView.of(rig).radius
    for camera in rig.cameras:
        place = ["world", "cameras", camera.name]
        pose = rerun.Transform3D(translation=camera.centre, mat3x3=camera.rotation.T)
        lens = rerun.Pinhole(
            image_from_camera=camera.intrinsics,
            resolution=[camera.width, camera.height],
            camera_xyz=rerun.ViewCoordinates.RDF,
            image_plane_distance=plane,
        )
        stream.log(place, pose, lens, static=True)


def _axes(rig: Rig | None) -> Any:
    """Returns Rerun's view coordinates for the axis closest to the rig's up direction, or y down if there is no rig."""
    import rerun

    up = np.array([0.0, -1.0, 0.0]) if rig is None else RigView.of(rig).up
    axis = int(np.abs(up).argmax())
    return getattr(rerun.ViewCoordinates, f"RIGHT_HAND_{'XYZ'[axis]}_{'UP' if up[axis] > 0 else 'DOWN'}")


def _log_points(
    stream: Any, given: Source, state: Gaussians, labels: NDArray[np.int64] | None, *, by_part: bool
) -> None:
    import rerun

    shown = np.flatnonzero(state.opacities >= FAINT)
    world = given.head.world
    classes = np.zeros(len(state), np.uint16)
    if labels is not None:
        known = min(len(labels), len(state))
        classes[:known] = labels[:known] + 1
    size = np.sqrt(np.square(state.factors[shown]).sum(axis=(1, 2)) / 3) / world.metres_per_unit
    colours = eight_bit(state.colours[shown])
    points = rerun.Points3D(
        world.to_user(state.means[shown]).astype(np.float32),
        radii=size.astype(np.float32),
        colors=None if by_part else colours,
        class_ids=classes[shown],
    )
    stream.log("world/gaussians", points)


def _longer(
    ways: deque[tuple[float, NDArray[np.float64]]],
    given: Source,
    state: Gaussians,
    rows: NDArray[np.intp],
    seconds: float,
    trail: float,
) -> NDArray[np.float64]:
    """Appends the positions of a state to the trails and returns the positions within the last `trail` seconds.

    Returns:
        Positions [S, K, 3] of K Gaussians in S states, with NaN where a Gaussian is absent.
    """
    places = given.head.world.to_user(state.means[rows])
    places[~state.present[rows]] = np.nan
    ways.append((seconds, places))
    while ways[0][0] < seconds - trail:
        ways.popleft()
    return np.stack([place for _, place in ways])


def _log_tracks(stream: Any, ways: NDArray[np.float64]) -> None:
    import rerun

    strips = {k: way[np.isfinite(way).all(axis=1)] for k, way in enumerate(np.moveaxis(ways, 1, 0))}
    strips = {k: way.astype(np.float32) for k, way in strips.items() if len(way) > 1}
    colours = [part_colour(k) for k in strips]
    stream.log("world/tracks", rerun.LineStrips3D(list(strips.values()), colors=colours, radii=THIN))
