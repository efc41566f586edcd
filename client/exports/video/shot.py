"""Validation of video options, and frame-by-frame rendering of a video."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from client.exports.sources import Source
from client.exports.video.camera_path import CameraPath, fixed_path, key_pose_path, orbit_path
from client.exports.video.moments import moments
from client.exports.video.overlay import Trails, moving_rows
from client.exports.video.part_paint import part_colours
from client.pictures import Picture, eight_bit
from scas4d_core.cameras import Camera, Rig
from scas4d_core.captures import Capture
from scas4d_core.captures.images import resize_area
from scas4d_core.errors import InputError

MOST_PICTURES = 1_000_000
"""Maximum number of images in a video. A larger number indicates a wrong frame rate or speed."""


@dataclass(frozen=True)
class VideoOptions:
    """Options of a video.

    Attributes:
        path: `orbit`, `camera`, or a JSON file of key poses (docs/videos.md).
        camera: name of a camera in the rig or the compared capture, used as the viewpoint or the start of the orbit;
            None for the first camera.
        orbit_speed: angular speed of the orbit in degrees per second, towards the camera's right.
        fps: video frame rate; None for the source's frame rate.
        speed: seconds of scene time per second of video.
        seconds: video duration in seconds; None for the duration of the frames.
        size: (width, height) of the rendered image; None for the camera's image size.
        interpolate: whether to interpolate states between frames.
        tracks: number of tracks to draw.
        trail: track length in seconds of video.
        parts: whether to colour Gaussians by part.
        background: RGB in [0, 1]; None for the scene's background.
    """

    path: str = "orbit"
    camera: str | None = None
    orbit_speed: float = 30.0
    fps: float | None = None
    speed: float = 1.0
    seconds: float | None = None
    size: tuple[int, int] | None = None
    interpolate: bool = False
    tracks: int = 0
    trail: float = 1.0
    parts: bool = False
    background: tuple[float, float, float] | None = None


@dataclass(frozen=True, eq=False)
class Shot:
    """Validated video that is ready to be rendered.

    Attributes:
        given: source of the states.
        times: time in seconds of each shown frame, keyed by frame index.
        options: requested options.
        fps: video frame rate.
        count: number of images in the video.
        size: (width, height) of the rendered image.
        path: camera path.
        truth: function that returns the ground-truth image of a frame at this size; None if no capture is compared.
    """

    given: Source
    times: Mapping[int, float]
    options: VideoOptions
    fps: float
    count: int
    size: tuple[int, int]
    path: CameraPath
    truth: Callable[[int], Picture] | None

    @property
    def whole_size(self) -> tuple[int, int]:
        """Width and height of the video."""
        return self.size[0] * (1 if self.truth is None else 2), self.size[1]

    def pictures(self) -> Iterator[Picture]:
        """Yields the images [H, W, 3] of the video, keeping only two states in memory at a time.

        Raises:
            InputError: if parts are requested but the source has none, or if tracks are requested but nothing moves.
        """
        from scas4d_core.engines.limits import DEFAULT, rig_limits
        from scas4d_core.query.view import ViewRenderer

        head, options = self.given.head, self.options
        limits = DEFAULT if head.rig is None else rig_limits("auto", head.world, head.rig.cameras)
        renderer = ViewRenderer(head.world, limits)
        background = head.background if options.background is None else options.background
        labels = self._labels() if options.parts else None
        trails = self._trails() if options.tracks else None
        indices, first = list(self.times), next(iter(self.times.values()))
        wanted = (first + number / self.fps * options.speed for number in range(self.count))
        states = self.given.states(indices[0], indices[-1])
        for number, moment in enumerate(moments(states, wanted, between=options.interpolate)):
            camera = self.path(number / self.fps)
            colours = None if labels is None else part_colours(moment.state, labels)
            picture = eight_bit(renderer.render(moment.state, camera, background, colours=colours).colour)
            if trails is not None:
                trails.add(moment.state)
                picture = trails.draw(picture, camera)
            yield picture if self.truth is None else np.concatenate([picture, self.truth(moment.frame)], axis=1)

    def _labels(self) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        labels = self.given.parts()
        if labels is None:
            raise InputError(
                f"parts: {self.given.name} contains no parts", "omit --parts; a scene without motion has no parts"
            )
        return labels

    def _trails(self) -> Trails:
        rows = moving_rows(self.given.some(list(self.times)), self.options.tracks)
        if not rows.size:
            raise InputError(
                "tracks: these frames contain no motion", "omit --tracks, or choose other frames with --frames"
            )
        return Trails(rows, self.given.head.world, round(self.options.trail * self.fps) + 1)


def plan_shot(
    given: Source, low: int, high: int, options: VideoOptions, compared: Capture | None, *, even: bool
) -> Shot:
    """Validates the options and returns the video to render.

    Args:
        given: source of the states.
        low: first frame.
        high: last frame.
        options: requested options.
        compared: capture whose ground-truth images are shown on the right, or None.
        even: whether width and height must be even. An odd camera size is rounded down, but an odd requested size is an
            error.

    Raises:
        InputError: if frames, a camera or images do not exist, or options are incompatible.
    """
    _check(options, compared)
    times = given.within(low, high)
    first, last = min(times.values()), max(times.values())
    fps = options.fps or given.rate
    # The last frame is shown for the duration of one image.
    length = (last - first) / options.speed + 1 / fps if options.seconds is None else options.seconds
    if length * fps > MOST_PICTURES:
        raise InputError(
            f"fps {fps:g} and speed {options.speed:g} result in {length * fps:.0f} images",
            f"change --frames, --fps or --speed to get at most {MOST_PICTURES}",
        )
    camera = _camera(given, options.camera, compared)
    size = _size(options.size, camera, even)
    shown = {index: (time - first) / options.speed for index, time in times.items()}
    path = _path(given.head.rig or Rig((camera,)), camera, size, options, shown)
    truth = None if compared is None else _truth(compared, camera, size, max(times))
    return Shot(given, times, options, fps, max(1, int(length * fps + 1e-6)), size, path, truth)


def _check(options: VideoOptions, compared: Capture | None) -> None:
    if compared is not None and options.path != "camera":
        raise InputError(
            f"compare cannot be used with path {options.path!r}",
            "use --path camera: only cameras have ground-truth images",
        )
    if compared is not None and options.interpolate:
        raise InputError(
            "compare and interpolate are mutually exclusive: there is no ground truth between frames",
            "omit one of them",
        )


def _camera(given: Source, name: str | None, compared: Capture | None) -> Camera:
    """Returns the camera with a given name, or the first camera if the name is None.

    The scene's refined cameras take precedence over the capture's cameras.

    Raises:
        InputError: if there are no cameras, or no camera has this name.
    """
    cameras = {}
    if compared is not None:
        cameras = {
            camera.name: camera for rig in (compared.full_rig, compared.full_test_rig) if rig for camera in rig.cameras
        }
    if given.head.rig is not None:
        cameras = {camera.name: camera for camera in given.head.rig.cameras} | {
            other: camera for other, camera in cameras.items() if other not in given.head.rig.names
        }
    if not cameras:
        raise InputError(
            f"{given.name} has no cameras; they are not read from USD and .glb files",
            "use the output folder of scas4d reconstruct, its .s4d file, or a capture with --compare",
        )
    if name is None:
        return next(iter(cameras.values()))
    if name not in cameras:
        raise InputError(f"camera {name!r} does not exist", f"choose from {', '.join(cameras)}")
    return cameras[name]


def _size(asked: tuple[int, int] | None, camera: Camera, even: bool) -> tuple[int, int]:
    width, height = asked or (camera.width, camera.height)
    if not even or not (width % 2 or height % 2):
        return width, height
    fits = max(width // 2 * 2, 2), max(height // 2 * 2, 2)
    if asked is not None:
        raise InputError(
            f"size {width}x{height} has an odd dimension, but MP4 requires even width and height",
            f"use {fits[0]}x{fits[1]}, or write a .webp file",
        )
    return fits


def _path(
    rig: Rig, camera: Camera, size: tuple[int, int], options: VideoOptions, shown: Mapping[int, float]
) -> CameraPath:
    if options.path == "orbit":
        return orbit_path(rig, camera, size, options.orbit_speed)
    if options.path == "camera":
        return fixed_path(camera, size)
    return key_pose_path(Path(options.path), rig, size, shown, camera)


def _truth(compared: Capture, camera: Camera, size: tuple[int, int], last: int) -> Callable[[int], Picture]:
    """Returns a function that maps a frame index to the ground-truth image, scaled and centred to fit the size.

    Raises:
        InputError: if the camera or the frame `last` is missing from the capture.
    """
    training = camera.name in compared.full_rig.names
    if not training and (compared.full_test_rig is None or camera.name not in compared.full_test_rig.names):
        raise InputError(f"compare: capture {compared.name} has no camera {camera.name!r}", "choose another --camera")
    if last >= compared.frame_count:
        raise InputError(
            f"compare: capture {compared.name} has {compared.frame_count} frames, but frame {last} is shown",
            f"set --frames to end at {compared.frame_count - 1}, or compare with the capture that was reconstructed",
        )
    scale = min(size[0] / camera.width, size[1] / camera.height)
    width, height = round(scale * camera.width), round(scale * camera.height)
    left, top = (size[0] - width) // 2, (size[1] - height) // 2

    def true(index: int) -> Picture:
        frame = compared.frame(index) if training else compared.test_frame(index)
        picture = np.zeros((size[1], size[0], 3), np.uint8)
        picture[top : top + height, left : left + width] = resize_area(frame.images[camera.name], (width, height))
        return picture

    return true
