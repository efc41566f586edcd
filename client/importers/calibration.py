"""Calibrations of rigs, independent of the tool that produced them. Requires only numpy."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from client.importers.lens import LensCamera
from scas4d_core.cameras import CAMERA_NAME
from scas4d_core.captures import CaptureError, InitialPoints

STATIC_TOLERANCE = 1e-6
"""Maximum relative difference in pose, intrinsics or distortion between images of a static camera."""


NAMES = (
    "names must have at most 64 letters, digits, dots, dashes and underscores, and must not be `time` or start with "
    "a dot, a dash or `mask.`"
)


@dataclass(frozen=True, eq=False)
class CalibratedImage:
    """Image listed in a calibration, with its camera.

    Attributes:
        path: path as written in the calibration file.
        lens: camera that took the image. The function `calibration` assigns its name.
        time: timestamp in seconds; None if the file contains none.
    """

    path: PurePosixPath
    lens: LensCamera
    time: float | None = None


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibrated rig with lens distortion.

    Attributes:
        source: file or folder from which the calibration was read.
        cameras: cameras in natural order of their names.
        views: images listed in the calibration, in temporal order, keyed by camera name.
        points: point cloud included in the calibration, or None.
        fps: frame rate; None if the file contains none.
        remarks: messages for the user about how the calibration was read.
        left_out: names of cameras that are in the file but not in the rig. A remark lists them.
    """

    source: Path
    cameras: tuple[LensCamera, ...]
    views: Mapping[str, tuple[CalibratedImage, ...]]
    points: InitialPoints | None = None
    fps: float | None = None
    remarks: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras, in the order of `cameras`."""
        return tuple(camera.name for camera in self.cameras)


def natural(text: str) -> list[tuple[int, int, str]]:
    """Returns a sort key for natural order, in which cam2 precedes cam10."""
    parts = re.split(r"(\d+)", text)
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part) for part in parts if part]


def calibration(
    source: Path, views: Sequence[CalibratedImage], *, points: InitialPoints | None = None, fps: float | None = None
) -> Calibration:
    """Builds a calibration by grouping images by camera.

    A camera is named after the folder of its images or, if all images are in one folder, after its image file.

    Raises:
        CaptureError: if there are no views, a camera moves, or a camera name is invalid.
    """
    if not views:
        raise CaptureError(f"{source} contains no cameras")
    one_folder = len({view.path.parent for view in views}) == 1
    by_name: dict[str, list[CalibratedImage]] = {}
    for view in views:
        by_name.setdefault(view.path.stem if one_folder else view.path.parent.name, []).append(view)
    cameras = []
    for name in sorted(by_name, key=natural):
        if not can_be_named(name):
            raise CaptureError(
                f"{source}: invalid camera name {name!r} (from {by_name[name][0].path}): {NAMES}; rename the images or "
                "their folder"
            )
        by_name[name].sort(key=lambda view: (view.time is not None, view.time or 0.0, natural(str(view.path))))
        cameras.append(_still(source, name, by_name[name]))
    return Calibration(
        source, tuple(cameras), {name: tuple(points_seen) for name, points_seen in by_name.items()}, points, fps
    )


def calibration_of_cameras(
    source: Path, cameras: Sequence[LensCamera], left_out: Sequence[str] = (), why: str = ""
) -> Calibration:
    """Builds a calibration from cameras without image names.

    The images are expected in `images/<camera>/` or `videos/<camera>.mp4`.

    Args:
        source: file or folder from which the calibration was read.
        cameras: cameras of the rig.
        left_out: names of cameras that are in the file but not in the rig.
        why: beginning of the remark that lists the cameras in `left_out`.

    Raises:
        CaptureError: if there are no cameras, a name occurs twice, or a name is invalid.
    """
    if not cameras:
        raise CaptureError(f"{source} contains no camera with a pose; calibrate the rig's extrinsics too")
    names = [camera.name for camera in cameras]
    for name in names:
        if not can_be_named(name):
            raise CaptureError(f"{source}: invalid camera name {name!r}: {NAMES}; rename the camera and its images")
        if names.count(name) > 1:
            raise CaptureError(f"{source}: two cameras are named {name!r}; rename one of them and its images")
    ordered = tuple(sorted(cameras, key=lambda camera: natural(camera.name)))
    views: dict[str, tuple[CalibratedImage, ...]] = {camera.name: () for camera in ordered}
    remarks = (f"{why}: {', '.join(left_out)}",) if left_out else ()
    return Calibration(source, ordered, views, remarks=remarks, left_out=tuple(left_out))


def can_be_named(name: str) -> bool:
    """Returns whether the service accepts a camera name. Accepted names cannot contain path separators."""
    return bool(re.fullmatch(CAMERA_NAME, name)) and name != "time" and not name.startswith("mask.")


def _still(source: Path, name: str, views: Sequence[CalibratedImage]) -> LensCamera:
    first = views[0].lens
    for view in views[1:]:
        for field in ("world_to_camera", "intrinsics", "distortion"):
            old, new = getattr(first, field), getattr(view.lens, field)
            if old.shape != new.shape or np.abs(new - old).max() > STATIC_TOLERANCE * max(1.0, np.abs(old).max()):
                raise CaptureError(
                    f"{source}: {field} of camera {name!r} differs between {views[0].path} and {view.path}; the "
                    "cameras of a rig must not move: calibrate with one image per camera, or put each camera's images "
                    "into a separate folder"
                )
    return LensCamera(
        name, first.model, first.intrinsics, first.distortion, first.world_to_camera, first.width, first.height
    )
