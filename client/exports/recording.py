"""`scas4d rerun`: frames as a recording for the Rerun viewer: points in their colours, tracks, the rig, parts."""

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
from client.progress import Bars, console
from client.wire import part_colour
from scas4d_core.cameras import Rig
from scas4d_core.errors import InputError
from scas4d_core.gaussians import Gaussians

SUFFIX = ".rrd"
FAINT = 0.1
"""Opacity below which a Gaussian is left out: points are drawn solid, and haze would hide what it lies before."""
THIN = -0.7
"""Radius of a track; the viewer takes what is negative for points of the screen."""
PLANE = 0.15
"""Distance at which the viewer draws a camera's picture, as a share of the rig's distance."""


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
    """Writes a recording; one state is in memory at a time.

    Args:
        source: as `opened` takes it. out: ends in `.rrd`; None: beside the source, named after it.
        frames: `A:B`, the frames from A to B, both counted in; None: all.
        tracks: how many of the Gaussians that move draw their way. trail: its length, seconds of the scene.
        parts: whether points have the colours of their parts; their own else. The part of each is recorded anyway.
        url, token: of the service.

    Returns:
        The file.

    Raises:
        InputError: a range or an output that cannot be. ModuleNotFoundError: rerun-sdk is not installed.
    """
    low, high = frame_range(frames)
    if out is not None and out.suffix.lower() != SUFFIX:
        raise InputError(f"out {str(out)!r} ends in {out.suffix!r}", f"give a name that ends in {SUFFIX}")
    with opened(source, low, high, parts, url, token) as given, Bars() as bars:
        if given.of.damage is not None:
            console.print(f"only a part can be read: {given.of.damage}", soft_wrap=True)
        times = given.within(low, high)
        target = out or given.beside / f"{given.name}{SUFFIX}"
        labels = given.parts()
        if parts and labels is None:
            raise InputError(f"parts: {given.name} holds none", "leave --parts out; there are none without motion")
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
    console.print(f"to look at it: rerun {target}", highlight=False, soft_wrap=True)
    return target


@contextmanager
def _stream(target: Path) -> Iterator[Any]:
    """A stream of the Rerun SDK into a file that has its name when it is whole."""
    import rerun
    from rerun import blueprint

    from scas4d_core.exports.atomic_files import atomic_path

    target.parent.mkdir(parents=True, exist_ok=True)
    look = blueprint.Blueprint(blueprint.Spatial3DView(origin="/world", name="scene"))
    with atomic_path(target) as beside:
        stream = rerun.RecordingStream("scas4d")
        stream.set_log_time_enabled(False)  # when it was written says nothing
        stream.save(beside, default_blueprint=look)
        try:
            yield stream
        finally:
            stream.disconnect()


def _log_what_stays(stream: Any, given: Source, labels: NDArray[np.int64] | None) -> None:
    """Logs axes, names and colours of parts, and the rig. A part's class is its label and 1; 0 is none."""
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
    """The axis of the user's world that is most upwards, by the rig; y down without one."""
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
    colours = np.rint(255 * np.clip(state.colours[shown], 0, 1)).astype(np.uint8)
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
    """[S, K, 3] the places of the last seconds, with those of a state; NaN where a Gaussian is not there."""
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
