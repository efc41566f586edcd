"""Camera paths for videos: an orbit, a fixed camera, or smoothly interpolated key poses."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from client.exports.video.key_poses import KeyPose, KeyPoses, pose_error, read_key_poses
from client.exports.video.rig_view import RigView, look_at
from scas4d_core.cameras import Camera, CameraError, Rig
from scas4d_core.errors import InputError

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

Float = NDArray[np.float64]
CameraPath = Callable[[float], Camera]
"""Function that maps a video time in seconds to a camera in the user's world, with the image size of the video."""

MAX_ELEVATION = np.radians(88)
"""Maximum elevation of an orbit in radians. At 90 degrees, the up direction would be undefined."""


def fit_to_size(camera: Camera, size: tuple[int, int]) -> Camera:
    """Returns the camera for another image size (width, height), with the original image scaled to fit and centred.

    >>> camera = Camera("a", [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4), 64, 48)
    >>> wide = fit_to_size(camera, (256, 96))
    >>> wide.fx, wide.cx, wide.cy
    (200.0, 128.0, 48.0)
    """
    width, height = size
    scale = min(width / camera.width, height / camera.height)
    lens = camera.intrinsics * [[scale], [scale], [1]]
    lens[0, 2] += (width - scale * camera.width) / 2
    lens[1, 2] += (height - scale * camera.height) / 2
    return Camera(camera.name, lens, camera.world_to_camera, width, height)


def centre_axis(camera: Camera, size: tuple[int, int]) -> Camera:
    """Same as ``fit_to_size``, but returns a camera with square pixels and the principal point at the image centre."""
    fitted_camera = fit_to_size(camera, size)
    scale = min(fitted_camera.fx, fitted_camera.fy)
    lens = np.array([[scale, 0, size[0] / 2], [0, scale, size[1] / 2], [0, 0, 1]])
    return Camera(fitted_camera.name, lens, fitted_camera.world_to_camera, *size)


def fixed_path(camera: Camera, size: tuple[int, int]) -> CameraPath:
    """Returns the path of a static camera.

    >>> camera = Camera("a", [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4), 64, 48)
    >>> fixed_path(camera, (64, 48))(3.0).cx
    32.0
    """
    fixed = fit_to_size(camera, size)
    return lambda seconds: fixed


def orbit_path(rig: Rig, start: Camera, size: tuple[int, int], turn: float) -> CameraPath:
    """Returns an orbit around the point that the rig looks at.

    Args:
        rig: rig that defines the orbit's centre and up direction.
        start: camera from which the orbit starts. Its image is scaled to fit the video.
        size: (width, height) of the video.
        turn: angular speed in degrees per second, towards the camera's right.

    >>> lens = [[100, 0, 32], [0, 100, 24], [0, 0, 1]]
    >>> pose = np.eye(4)
    >>> pose[2, 3] = 2  # two units in front of the target
    >>> rig = Rig((Camera("a", lens, pose, 64, 48),))
    >>> path = orbit_path(rig, rig["a"], (64, 48), turn=90)
    >>> path(0.0).centre.round(6) + 0, path(1.0).centre.round(6) + 0
    (array([ 0.,  0., -2.]), array([2., 0., 0.]))
    """
    from scipy.spatial.transform import Rotation

    view, lens = RigView.of(rig), centre_axis(start, size)
    offset = start.centre - view.target
    distance = float(np.linalg.norm(offset)) or view.radius
    height = float(offset @ view.up)
    flat = offset - height * view.up
    if np.linalg.norm(flat) < 1e-6 * distance:  # directly above or below the target: any horizontal direction will do
        flat = np.cross(view.up, np.eye(3)[np.abs(view.up).argmin()])
    pitch = float(np.clip(np.arctan2(height, np.linalg.norm(flat)), -MAX_ELEVATION, MAX_ELEVATION))
    flat = flat / np.linalg.norm(flat)

    def at(seconds: float) -> Camera:
        around = Rotation.from_rotvec(view.up * np.radians(turn) * seconds).apply(flat)
        eye = view.target + distance * (np.cos(pitch) * around + np.sin(pitch) * view.up)
        return look_at(lens, eye, view.target, view.up)

    return at


def key_pose_path(
    file: Path, rig: Rig, size: tuple[int, int], seconds_of_frame: Mapping[int, float], start: Camera
) -> CameraPath:
    """Returns the path through the key poses in a file.

    The camera is static before the first key and after the last key. Positions follow a natural cubic spline. If every
    key has a `look_at` point, these points also follow a spline. Otherwise, rotations are interpolated with
    ``scipy.spatial.transform.RotationSpline``.

    Args:
        file: JSON file of key poses.
        rig: rig that defines the default up direction.
        size: (width, height) of the video.
        seconds_of_frame: video time in seconds of each frame of the scene, keyed by frame index.
        start: camera that defines the field of view if no key does.

    Raises:
        InputError: if the file is invalid. The message names the field.
    """
    given = read_key_poses(file)
    lens = centre_axis(start, size)
    times = _times(given, seconds_of_frame, file)
    up = RigView.of(rig).up if given.up is None else np.array(given.up) / np.linalg.norm(given.up)
    poses = [_camera(key, place, lens, up, file) for place, key in enumerate(given.keys)]
    focal = _focal_lengths(given, times, lens)
    place_of = _spline(times, [camera.centre for camera in poses])
    aims = [key.look_at for key in given.keys if key.look_at is not None]
    if len(aims) == len(given.keys):
        aim_of = _spline(times, aims)
        pose_at: CameraPath = lambda t: look_at(lens, place_of(t), aim_of(t), up)  # noqa: E731
    else:
        pose_at = _interpolated_rotations(times, poses, place_of, lens)

    def at(seconds: float) -> Camera:
        now = float(np.clip(seconds, times[0], times[-1]))
        camera = pose_at(now)
        sharp = camera.intrinsics.copy()
        sharp[0, 0] = sharp[1, 1] = np.interp(now, times, focal)
        return Camera(camera.name, sharp, camera.world_to_camera, *size)

    return at


def _times(given: KeyPoses, seconds_of_frame: Mapping[int, float], file: Path) -> Float:
    times: list[float] = []
    for place, key in enumerate(given.keys):
        if key.time is not None:
            times.append(key.time)
        elif key.frame is not None and key.frame in seconds_of_frame:
            times.append(seconds_of_frame[key.frame])
        else:
            held = f"{min(seconds_of_frame)} to {max(seconds_of_frame)}"
            raise InputError(
                f"{file.name}: keys[{place}].frame {key.frame} is not in the video", f"the video shows frames {held}"
            )
        if place and times[-1] <= times[-2]:
            field = "time" if key.time is not None else "frame"
            raise InputError(
                f"{file.name}: keys[{place}].{field} {getattr(key, field)} is not later than keys[{place - 1}]",
                "list the keys in chronological order",
            )
    return np.array(times)


def _camera(key: KeyPose, place: int, lens: Camera, up: Float, file: Path) -> Camera:
    if key.position is not None and key.look_at is not None:
        return look_at(lens, np.array(key.position), np.array(key.look_at), up)
    try:
        return Camera(f"keys[{place}]", lens.intrinsics, np.array(key.world_to_camera), lens.width, lens.height)
    except CameraError as error:
        raise pose_error(file, place, error) from None


def _focal_lengths(given: KeyPoses, times: Float, lens: Camera) -> Float:
    """Returns the focal lengths [K] of the keys in pixels, interpolated for keys without a field of view."""
    said = [
        (time, lens.height / 2 / np.tan(np.radians(key.field_of_view) / 2))
        for time, key in zip(times.tolist(), given.keys, strict=True)
        if key.field_of_view is not None
    ]
    if not said:
        return np.full(len(times), lens.fy)
    return np.interp(times, *np.array(said).T)


def _spline(times: Float, points: Sequence[Sequence[float] | Float]) -> Callable[[float], Float]:
    """Returns a natural cubic spline through points [K, 3] as a function of time."""
    from scipy.interpolate import CubicSpline

    through = np.array(points, np.float64)
    if len(through) == 1:
        return lambda seconds: through[0]
    spline: CubicSpline[np.float64] = CubicSpline(times, through, bc_type="natural")
    return lambda seconds: np.asarray(spline(seconds), np.float64)


def _interpolated_rotations(
    times: Float, poses: list[Camera], place_of: Callable[[float], Float], lens: Camera
) -> CameraPath:
    from scipy.spatial.transform import Rotation, RotationSpline

    turns = Rotation.from_matrix(np.stack([camera.rotation for camera in poses]))
    spline = RotationSpline(times, turns) if len(poses) > 1 else None

    def at(seconds: float) -> Camera:
        rotation = (turns[0] if spline is None else spline(seconds)).as_matrix()
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ place_of(seconds)
        return Camera(lens.name, lens.intrinsics, pose, lens.width, lens.height)

    return at
