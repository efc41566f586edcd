"""Reads nerfstudio's `transforms.json`, which instant-ngp also writes, and the split files of Blender data sets.

Each image has `file_path`, `transform_matrix` (camera to world, OpenGL axes: x right, y up, z back), and optionally
`time`. The intrinsics `camera_model`, `w`, `h`, `fl_x`, `fl_y`, `cx`, `cy`, `k1` … are at the top level or in an
image's entry, which takes precedence. `camera_angle_x` or `_y` (radians) or `x_fov`, `y_fov` (degrees) may replace
focal lengths. As in instant-ngp, the size is that of the image if `w` and `h` are missing, and the principal point is
the image centre if `cx` and `cy` are missing. `file_path` may be absolute, or lack the extension. Images without a
`transform_matrix` are left out. `applied_transform` (3×4, on the world) and `applied_scale` are undone, so the rig
keeps the coordinates of the original calibration. Two fields are not read: `mask_path`, which marks pixels to ignore
rather than the foreground, and `ply_file_path`, a point cloud.

Without `transforms.json`, `transforms_train.json` is read. Cameras that are only in `transforms_val.json` or
`transforms_test.json` are held out for evaluation.
(docs.nerf.studio, "Data conventions"; `nerfstudio/data/dataparsers/nerfstudio_dataparser.py`;
github.com/NVlabs/instant-ngp, `docs/nerf_dataset_tips.md`, `src/nerf_loader.cu`; the Blender data set of NeRF.)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.importers.calibration import CalibratedImage, Calibration, calibration, listed, stem
from client.importers.folders import image_size, size_of_pictures
from client.importers.formats.documents import json_value, number, positive, whole
from client.importers.lens import MODELS, lens_camera
from client.importers.pictures import find_picture
from scas4d_core.captures import CaptureError
from scas4d_core.captures.files import read_json

Float = NDArray[np.float64]

FILE = "transforms.json"
SPLITS = ("transforms_train.json", "transforms_val.json", "transforms_test.json")
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""Converts OpenGL's camera axes to OpenCV's."""
COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


def find_transforms(folder: Path) -> list[Path]:
    """Returns `transforms.json`, or the split files; empty if there are none."""
    if (folder / FILE).is_file():
        return [folder / FILE]
    return [folder / name for name in SPLITS if (folder / name).is_file()]


def is_transforms(path: Path) -> bool:
    """Returns whether a file is named like a `transforms.json`, or is a JSON file that lists frames."""
    if path.suffix.lower() != ".json":
        return False
    if path.name.startswith("transforms"):
        return True
    document = json_value(path)
    return isinstance(document, dict) and "frames" in document


@dataclass(frozen=True)
class _File:
    """A parsed file, and what its images have in common."""

    path: Path
    capture: Path
    meta: Mapping[str, Any]
    undo: Float
    scale: float


def read_transforms(paths: Sequence[Path], capture: Path) -> Calibration:
    """Reads the rig from a `transforms.json`, or from the split files.

    Args:
        paths: one file, or several. Cameras that are not in the first one are held out for evaluation.
        capture: capture folder, whose images supply missing sizes.

    Raises:
        CaptureError: if a field is missing or invalid. The message names the file, image, field and remedy.
        MissingExtraError: if a size must be read from a video, and PyAV is not installed.
    """
    views: dict[tuple[PurePosixPath, float | None], CalibratedImage] = {}
    unposed: list[PurePosixPath] = []
    training: list[PurePosixPath] = []
    fps = None
    for path in paths:
        file = _open(path, capture)
        for index, frame in enumerate(file.meta["frames"]):
            view = _view(file, f"{path}: frames[{index}]", frame)
            if isinstance(view, CalibratedImage):
                views.setdefault((view.path, view.time), view)
            else:
                unposed.append(view)
        if path == paths[0]:
            training = [*(view.path for view in views.values()), *unposed]
        if fps is None and file.meta.get("fps") is not None:
            fps = positive(str(path), file.meta, "fps")
    read = calibration(paths[0], list(views.values()), fps=fps, unposed=unposed, training=training)
    remarks = [f"read {', '.join(path.name for path in paths)}"] if len(paths) > 1 else []
    if read.test:
        remarks.append(f"held out for evaluation, as they are not in {paths[0].name}: {listed(read.test)}")
    return replace(read, remarks=(*remarks, *read.remarks))


def _open(path: Path, capture: Path) -> _File:
    meta = read_json(path)
    if not isinstance(meta.get("frames"), list) or not meta["frames"]:
        raise CaptureError(
            f"{path} has no frames; `frames` must list entries with file_path and transform_matrix, one per camera"
        )
    return _File(path, capture, meta, _undo_world(path, meta), positive(str(path), meta, "applied_scale", 1.0))


def _view(file: _File, where: str, frame: Any) -> CalibratedImage | PurePosixPath:
    """Returns an image with its camera, or only its path if it has no pose."""
    if not isinstance(frame, dict):
        raise CaptureError(f"{where} must be an object; got {type(frame).__name__}")
    name = frame.get("file_path")
    if not isinstance(name, str) or not PurePosixPath(name).name:
        raise CaptureError(f"{where}: missing file_path")
    where = f"{where} ({name})"
    path = PurePosixPath(name.replace("\\", "/"))  # paths written on Windows
    if frame.get("transform_matrix") is None:
        return path
    to_world = _matrix(where, frame, "transform_matrix")
    to_world[:3, 3] /= file.scale
    given = {**file.meta, **frame}
    size = _size(file, where, given, path)
    model = given.get("camera_model") or _default_model(given)
    if not isinstance(model, str):
        raise CaptureError(f"{where}: unknown camera_model {model!r}; choose from {', '.join(MODELS)}")
    fx, fy = (_focal(where, given, axis, side) for axis, side in zip("xy", size, strict=True))
    if fx is None and fy is None:
        raise CaptureError(
            f"{where}: missing fl_x (not set at the top level either); set it to the focal length in pixels, or set "
            "camera_angle_x to the field of view in radians"
        )
    if given.get("cx") is None and given.get("cy") is None:
        given |= {"cx": size[0] / 2, "cy": size[1] / 2}
    parameters = {
        "fx": fx or fy or 0.0,
        "fy": fy or fx or 0.0,
        "cx": _number(where, given, "cx"),
        "cy": _number(where, given, "cy"),
        **{key: _number(where, given, key) for key in COEFFICIENTS if given.get(key) is not None},
    }
    try:
        pose = FLIP @ np.linalg.inv(file.undo @ to_world)
    except np.linalg.LinAlgError as fault:
        raise CaptureError(f"{where}: transform_matrix cannot be inverted; set it to a camera-to-world pose") from fault
    camera = lens_camera(name, model, parameters, pose, size, source=where)
    time = _number(where, frame, "time") if frame.get("time") is not None else None
    return CalibratedImage(path, camera, time)


def _size(file: _File, where: str, given: Mapping[str, Any], path: PurePosixPath) -> tuple[int, int]:
    """Returns (width, height) as in the file or, if it has neither, of the image."""
    if given.get("w") is not None or given.get("h") is not None:
        return whole(where, given, "w"), whole(where, given, "h")
    picture = find_picture(file.capture, file.path, str(path))
    if picture is not None:
        return image_size([picture])
    try:
        return size_of_pictures(file.capture, path.parent.name, where)
    except CaptureError:
        return size_of_pictures(file.capture, stem(path), where)


def _default_model(given: Mapping[str, Any]) -> str:
    """Infers the camera model from `is_fisheye` and the coefficients, because instant-ngp's files omit it."""
    if given.get("is_fisheye"):
        return "OPENCV_FISHEYE"
    return "OPENCV" if any(given.get(key) for key in COEFFICIENTS) else "PINHOLE"


def _undo_world(path: Path, meta: Mapping[str, Any]) -> Float:
    if meta.get("applied_transform") is None:
        return np.eye(4)
    applied = _matrix(str(path), meta, "applied_transform")
    try:
        return np.asarray(np.linalg.inv(applied), np.float64)
    except np.linalg.LinAlgError as fault:
        raise CaptureError(f"{path}: applied_transform cannot be inverted; omit it, or set it to a rotation") from fault


def _focal(where: str, given: Mapping[str, Any], axis: str, pixels: int) -> float | None:
    """Returns the focal length along an axis in pixels, or None if the file has none."""
    if given.get(f"fl_{axis}") is not None:
        return positive(where, given, f"fl_{axis}")
    for key, unit, name in ((f"camera_angle_{axis}", 1.0, "radians"), (f"{axis}_fov", math.pi / 180, "degrees")):
        if given.get(key) is not None:
            angle = _number(where, given, key)
            if not 0 < angle * unit < math.pi:
                raise CaptureError(f"{where}: {key} must be between 0 and {math.pi / unit:g} {name}; got {angle:g}")
            return pixels / 2 / math.tan(angle * unit / 2)
    return None


def _matrix(where: str, given: Mapping[str, Any], key: str) -> Float:
    try:
        rows = np.array(given[key], dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        rows = np.empty(0)
    if rows.shape not in ((3, 4), (4, 4)) or not np.isfinite(rows).all():
        raise CaptureError(f"{where}: {key} must be a 4x4 or 3x4 matrix of finite numbers")
    return np.concatenate([rows[:3], [[0.0, 0.0, 0.0, 1.0]]])


def _number(where: str, given: Mapping[str, Any], key: str) -> float:
    if given.get(key) is None:
        raise CaptureError(f"{where}: missing {key} (not set at the top level either)")
    return number(where, given, key)
