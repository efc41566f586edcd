"""Cameras in OpenCV's conventions, which most lab tools store in their own file formats. Requires only numpy.

`matrix` is [3, 3] with the centre of the first pixel at (0, 0), so half a pixel is added to principal points here.
`distortions` are in OpenCV's order. The world-to-camera transform consists of a rotation (matrix or Rodrigues vector)
and a translation: `X_cam = R X_world + t`. The camera's axes are x right, y down and z forward.
(docs.opencv.org, "Camera Calibration and 3D Reconstruction".)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.importers.formats.documents import short
from client.importers.lens import FISHEYE, PERSPECTIVE, LensCamera, lens_camera
from scas4d_core.captures import CaptureError

Float = NDArray[np.float64]

HALF = 0.5
"""Position of the first pixel's centre in this project's coordinates. In OpenCV, the centre is at (0, 0)."""
COUNTS = (0, 4, 5, 8, 12, 14)
"""Supported numbers of OpenCV coefficients. Coefficients beyond the eighth (thin prism, tilted sensor) must be 0."""
SKEW = 1e-6
"""Maximum skew, relative to the focal length, that is treated as a rounding error."""
LARGEST_SIDE = 1 << 16
MOST = 64
"""Number of values, or of rows of values, after which a list is cut, because no field has as many."""


def opencv_camera(
    where: str,
    name: str,
    *,
    matrix: Any,
    distortions: Any,
    rotation: Any,
    translation: Any,
    size: tuple[int, int],
    fisheye: bool = False,
    first_pixel: float = 0.0,
) -> LensCamera:
    """Creates and validates a camera from the values stored by a calibration tool.

    Args:
        where: file and position in the file, for messages.
        name: camera name.
        matrix: camera matrix [3, 3].
        distortions: 4, 5 or 8 coefficients (4 for a fisheye), or None. Further coefficients must be 0.
        rotation: world-to-camera rotation, [3, 3] or a Rodrigues vector [3].
        translation: world-to-camera translation [3].
        size: (width, height) in pixels.
        fisheye: whether the coefficients are those of `cv2.fisheye`.
        first_pixel: coordinate of the first pixel's centre, 0 or 0.5.

    Raises:
        CaptureError: if a field is invalid. The message names the field and the remedy.

    >>> lens = [[100, 0, 31.5], [0, 100, 23.5], [0, 0, 1]]
    >>> camera = opencv_camera("rig.toml", "front", matrix=lens, distortions=[0, 0, 0, 0, 0], rotation=[0, 0, np.pi],
    ...                        translation=[0, 0, 2], size=(64, 48))
    >>> camera.model, camera.intrinsics[:2, 2].tolist(), camera.pinhole().centre.round(6).tolist()[2]
    ('PINHOLE', [32.0, 24.0], -2.0)
    """
    k = numbers(where, "the camera matrix", matrix, (9,)).reshape(3, 3)
    if np.abs(k[2, :2]).max() > 0 and not k[:2, 2].any():
        raise CaptureError(
            f"{where}: the camera matrix has cx, cy in its last row: it is transposed, as in MATLAB; transpose it"
        )
    if not np.allclose([k[1, 0], *k[2]], [0, 0, 0, 1]) or abs(k[0, 1]) > SKEW * abs(k[0, 0]):
        raise CaptureError(
            f"{where}: the camera matrix {k.tolist()} is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; "
            "calibrate without skew"
        )
    model, coefficients = _distortion(where, distortions, fisheye)
    pose = np.eye(4)
    pose[:3, :3] = _rotation(where, rotation)
    pose[:3, 3] = numbers(where, "translation", translation, (3,))
    shift = HALF - first_pixel
    parameters = {"fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2] + shift, "cy": k[1, 2] + shift, **coefficients}
    return lens_camera(name, model, parameters, pose, size, source=where)


def camera_of_table(where: str, name: str, table: Mapping[str, Any]) -> LensCamera:
    """Returns a camera from a table with the fields of aniposelib, which caliscope also writes.

    Raises:
        CaptureError: as for `opencv_camera`.
    """
    return opencv_camera(
        where,
        name,
        matrix=table.get("matrix"),
        distortions=table.get("distortions"),
        rotation=table.get("rotation"),
        translation=table.get("translation"),
        size=picture_size(where, table.get("size")),
        fisheye=table.get("fisheye") is True,
    )


def _distortion(where: str, given: Any, fisheye: bool) -> tuple[str, dict[str, float]]:
    """Returns the lens model and its coefficients, keyed by name."""
    values = numbers(where, "distortions", [] if given is None else given, (4,) if fisheye else COUNTS)
    if fisheye:
        return "OPENCV_FISHEYE", dict(zip(FISHEYE, values, strict=True))
    if values[8:].any():
        raise CaptureError(
            f"{where} has thin prism or tilted sensor distortion ({', '.join(f'{v:g}' for v in values[8:])}), "
            "which is not supported; calibrate with at most the rational model (8 coefficients)"
        )
    named = dict(zip(PERSPECTIVE, values[:8], strict=False))
    if not values.any():
        return "PINHOLE", {}
    return "FULL_OPENCV" if values[5:].any() else "OPENCV", {key: value for key, value in named.items() if value}


def _rotation(where: str, given: Any) -> Float:
    values = numbers(where, "rotation", given, (3, 9))
    return rodrigues(values) if values.size == 3 else values.reshape(3, 3)


def rodrigues(vector: Float) -> Float:
    """Returns the rotation matrix [3, 3] for a Rodrigues vector [3], whose length is the angle in radians.

    >>> np.round(rodrigues(np.array([0, 0, np.pi / 2])))[0].tolist()
    [0.0, -1.0, 0.0]
    """
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    result: Float = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return result


def numbers(where: str, field: str, given: Any, counts: Sequence[int]) -> Float:
    """Returns the numbers in a list, or in a list of rows, as a flat float64 array. They may be written as strings.

    Raises:
        CaptureError: if a value is not a finite number, or the number of values is not in `counts`.
    """
    try:
        rows = given.tolist() if isinstance(given, np.ndarray) else [] if isinstance(given, str) else given
        rows = [value for row in rows[:MOST] for value in (row[:MOST] if isinstance(row, list | tuple) else [row])]
        values = np.array([np.nan if isinstance(value, bool) else float(value) for value in rows], np.float64)
    except (TypeError, ValueError, KeyError, OverflowError):
        values = np.empty(0)
        counts = [count for count in counts if count] or counts
    if values.size not in counts or not np.isfinite(values).all():
        listed = " or ".join(str(count) for count in counts if count or len(counts) == 1)
        raise CaptureError(f"{where}: {field} must be {listed} finite numbers; got {short(given)}")
    return values


def picture_size(where: str, given: Any) -> tuple[int, int]:
    """Returns (width, height) as integers. Some tools write them as floats, such as 1088.0.

    Raises:
        CaptureError: if the size is invalid.
    """
    values = numbers(where, "size", given, (2,))
    if (values != np.round(values)).any() or values.min() < 1 or values.max() > LARGEST_SIDE:
        raise CaptureError(f"{where}: size must be a width and height in whole pixels; got {short(given)}")
    return int(values[0]), int(values[1])
