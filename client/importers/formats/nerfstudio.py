"""Reads nerfstudio's `transforms.json`, which instant-ngp also writes. Requires only numpy.

Each image has `file_path`, `transform_matrix` (camera to world, OpenGL axes: x right, y up, z back), and optionally
`time`. The intrinsics `camera_model`, `w`, `h`, `fl_x`, `fl_y` (or `camera_angle_x`, radians), `cx`, `cy`, `k1` … are
at the top level or in an image's entry, which takes precedence. `applied_transform` (3×4, on the world) and
`applied_scale` are undone, so the rig keeps the coordinates of the original calibration. Two fields are not read:
`mask_path`, which marks pixels to ignore rather than the foreground, and `ply_file_path`, a point cloud.
(docs.nerf.studio, "Data conventions"; `nerfstudio/data/dataparsers/nerfstudio_dataparser.py`.)
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.importers.calibration import CalibratedImage, Calibration, calibration
from client.importers.lens import MODELS, lens_camera
from scas4d_core.captures import CaptureError
from scas4d_core.captures.files import read_json

Float = NDArray[np.float64]

FILE = "transforms.json"
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""Converts OpenGL's camera axes to OpenCV's."""
COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


def read_transforms(path: Path) -> Calibration:
    """Reads the rig from a `transforms.json`.

    Raises:
        CaptureError: if a field is missing or invalid. The message names the file, image, field and remedy.
    """
    meta = read_json(path)
    frames = meta.get("frames")
    if not isinstance(frames, list) or not frames:
        raise CaptureError(
            f"{path} has no frames; `frames` must list entries with file_path and transform_matrix, one per camera"
        )
    undo = _undo_world(path, meta)
    views = []
    for number, frame in enumerate(frames):
        where = f"{path}: frames[{number}]"
        if not isinstance(frame, dict):
            raise CaptureError(f"{where} must be an object; got {type(frame).__name__}")
        views.append(_view(where, meta, frame, undo, meta.get("applied_scale", 1.0)))
    fps = _number(str(path), meta, "fps") if "fps" in meta else None
    if fps is not None and fps <= 0:
        raise CaptureError(f"{path}: fps must be positive; got {fps:g}")
    return calibration(path, views, fps=fps)


def _view(where: str, meta: Mapping[str, Any], frame: Mapping[str, Any], undo: Float, scale: float) -> CalibratedImage:
    file = frame.get("file_path")
    if not isinstance(file, str) or not PurePosixPath(file).name:
        raise CaptureError(f"{where}: missing file_path")
    where = f"{where} ({file})"
    file = file.replace("\\", "/")  # paths written on Windows
    to_world = _matrix(where, frame, "transform_matrix")
    to_world[:3, 3] /= scale
    given = {**meta, **frame}
    size = (_whole(where, given, "w"), _whole(where, given, "h"))
    model = given.get("camera_model") or _default_model(given)
    if not isinstance(model, str):
        raise CaptureError(f"{where}: unknown camera_model {model!r}; choose from {', '.join(MODELS)}")
    fx = _focal(where, given, "x", size[0])
    parameters = {
        "fx": fx,
        "fy": _focal(where, given, "y", size[1]) if "fl_y" in given or "camera_angle_y" in given else fx,
        "cx": _number(where, given, "cx"),
        "cy": _number(where, given, "cy"),
        **{key: _number(where, given, key) for key in COEFFICIENTS if given.get(key) is not None},
    }
    try:
        pose = FLIP @ np.linalg.inv(undo @ to_world)
    except np.linalg.LinAlgError as fault:
        raise CaptureError(f"{where}: transform_matrix cannot be inverted; set it to a camera-to-world pose") from fault
    camera = lens_camera(file, model, parameters, pose, size, source=where)
    path = PurePosixPath(file)
    time = _number(where, frame, "time") if frame.get("time") is not None else None
    return CalibratedImage(path, camera, time)


def _default_model(given: Mapping[str, Any]) -> str:
    """Infers the camera model from `is_fisheye` and the coefficients, because instant-ngp's files omit it."""
    if given.get("is_fisheye"):
        return "OPENCV_FISHEYE"
    return "OPENCV" if any(given.get(key) for key in COEFFICIENTS) else "PINHOLE"


def _undo_world(path: Path, meta: Mapping[str, Any]) -> Float:
    if "applied_scale" in meta and _number(str(path), meta, "applied_scale") <= 0:
        raise CaptureError(f"{path}: applied_scale must be positive; got {meta['applied_scale']!r}")
    if meta.get("applied_transform") is None:
        return np.eye(4)
    applied = _matrix(str(path), meta, "applied_transform")
    try:
        return np.asarray(np.linalg.inv(applied), np.float64)
    except np.linalg.LinAlgError as fault:
        raise CaptureError(f"{path}: applied_transform cannot be inverted; omit it, or set it to a rotation") from fault


def _focal(where: str, given: Mapping[str, Any], axis: str, pixels: int) -> float:
    if given.get(f"fl_{axis}") is not None:
        return _number(where, given, f"fl_{axis}")
    if given.get(f"camera_angle_{axis}") is not None:
        angle = _number(where, given, f"camera_angle_{axis}")
        if not 0 < angle < math.pi:
            raise CaptureError(f"{where}: camera_angle_{axis} must be between 0 and pi radians; got {angle:g}")
        return pixels / 2 / math.tan(angle / 2)
    raise CaptureError(
        f"{where}: missing fl_{axis} (not set at the top level either); set it to the focal length in pixels"
    )


def _matrix(where: str, given: Mapping[str, Any], key: str) -> Float:
    if key not in given:
        raise CaptureError(f"{where}: missing {key}")
    try:
        rows = np.array(given[key], dtype=np.float64)
    except (TypeError, ValueError):
        rows = np.empty(0)
    if rows.shape not in ((3, 4), (4, 4)) or not np.isfinite(rows).all():
        raise CaptureError(f"{where}: {key} must be a 4x4 or 3x4 matrix of finite numbers")
    return np.concatenate([rows[:3], [[0.0, 0.0, 0.0, 1.0]]])


def _number(where: str, given: Mapping[str, Any], key: str) -> float:
    value = given.get(key)
    if value is None:
        raise CaptureError(f"{where}: missing {key} (not set at the top level either)")
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise CaptureError(f"{where}: {key} must be a finite number; got {value!r}")
    return float(value)


def _whole(where: str, given: Mapping[str, Any], key: str) -> int:
    value = _number(where, given, key)
    if value != round(value) or not 1 <= value <= 1 << 16:
        raise CaptureError(f"{where}: {key} must be a whole number of pixels from 1 to 65536; got {value:g}")
    return int(value)
