"""Reads Meshroom's `cameras.sfm` and AliceVision's `sfm.json`.

`views` (images) refer to `intrinsics` and `poses` by id. A pose has the world-to-camera `rotation` [9], stored by
columns, and the camera's `center` [3], with OpenCV's axes. The focal length is in pixels (`pxFocalLength`) before
version 1.2.2, and afterwards in millimetres of `sensorWidth`. `principalPoint` is relative to the image centre
(width/2, height/2) from version 1.2.1 on. Pixel coordinates are those of AliceVision's undistortion, in which the
first pixel is centred at (0, 0). Images without a pose are left out, and a remark lists them.
(github.com/alicevision/AliceVision, `sfmDataIO/jsonIO.cpp`, `camera/DistortionRadial.cpp`, `DistortionBrown.cpp`,
`DistortionFisheye.cpp`, `cameraUndistortImage.hpp`.)
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.importers.calibration import CalibratedImage, Calibration, calibration
from client.importers.formats.documents import number, positive, short, table, whole
from client.importers.formats.opencv_camera import HALF, numbers
from client.importers.lens import FISHEYE, LensCamera, lens_camera
from scas4d_core.captures import CaptureError, InitialPoints
from scas4d_core.captures.files import read_json

DISTORTIONS = {
    "none": ("PINHOLE", ()),
    "pinhole": ("PINHOLE", ()),
    "radial1": ("SIMPLE_RADIAL", ("k1",)),
    "radial3": ("OPENCV", ("k1", "k2", "k3")),
    "radialk1": ("SIMPLE_RADIAL", ("k1",)),
    "radialk3": ("OPENCV", ("k1", "k2", "k3")),
    "brown": ("OPENCV", ("k1", "k2", "k3", "p1", "p2")),
    "fisheye4": ("OPENCV_FISHEYE", FISHEYE),
}
"""Model of `client.importers.lens.MODELS` and order of `distortionParams`, keyed by `type` or `distortionType`."""


def is_meshroom(document: Any) -> bool:
    """Returns whether a parsed JSON file has views and intrinsics."""
    return isinstance(document, dict) and {"views", "intrinsics"} <= document.keys()


def read_meshroom(path: Path) -> Calibration:
    """Reads the rig, and the point cloud if the file contains one.

    Raises:
        CaptureError: if a field is missing or invalid. The message names the file, image, field and remedy.
    """
    document = read_json(path)
    version = tuple(int(part) for part in numbers(str(path), "version", document.get("version"), (3,)))
    intrinsics = _by_id(path, document, "intrinsics", "intrinsicId")
    poses = _by_id(path, document, "poses", "poseId")
    views, unposed = [], []
    for view in _by_id(path, document, "views", "viewId").values():
        name = view.get("path")
        if not isinstance(name, str) or not name:
            raise CaptureError(f"{path}: view {view.get('viewId')}: path must be a string; got {name!r}")
        file = PurePosixPath(name.replace("\\", "/"))
        if "rigId" in view:
            raise CaptureError(
                f"{path}: view {file.name!r} belongs to a rig of Meshroom, which is not supported; use none"
            )
        pose = poses.get(str(view.get("poseId")))
        if pose is None:
            unposed.append(file)
            continue
        where = f"{path}: view {file.name!r}"
        lens = intrinsics.get(str(view.get("intrinsicId")))
        if lens is None:
            raise CaptureError(f"{where}: intrinsicId {view.get('intrinsicId')!r} is not in intrinsics")
        views.append(CalibratedImage(file, _lens(where, name, lens, _pose(where, pose), version)))
    return calibration(path, views, points=_points(path, document), unposed=unposed)


def _by_id(path: Path, document: Mapping[str, Any], key: str, id: str) -> dict[str, Mapping[str, Any]]:
    entries = document.get(key) or []
    if not isinstance(entries, list):
        raise CaptureError(f"{path}: {key} must be a list; got {type(entries).__name__}")
    tables = [table(str(path), entry, f"{key}[{index}]") for index, entry in enumerate(entries)]
    return {str(entry.get(id)): entry for entry in tables}


def _pose(where: str, given: Mapping[str, Any]) -> NDArray[np.float64]:
    transform = table(where, table(where, given.get("pose"), "pose").get("transform"), "transform")
    pose = np.eye(4)
    pose[:3, :3] = numbers(where, "rotation", transform.get("rotation"), (9,)).reshape(3, 3).T
    pose[:3, 3] = -pose[:3, :3] @ numbers(where, "center", transform.get("center"), (3,))
    return pose


def _lens(
    where: str, name: str, lens: Mapping[str, Any], pose: NDArray[np.float64], version: tuple[int, ...]
) -> LensCamera:
    kind = lens.get("type")
    kind = lens.get("distortionType", kind) if kind == "pinhole" else kind
    if not isinstance(kind, str) or kind not in DISTORTIONS or lens.get("undistortionType", "none") != "none":
        raise CaptureError(
            f"{where}: unsupported distortion {short(kind)} (or an undistortion); calibrate with one of "
            f"{', '.join(DISTORTIONS)}"
        )
    model, order = DISTORTIONS[kind]
    width, height = whole(where, lens, "width"), whole(where, lens, "height")
    fx, fy = _focal(where, lens, width, version)
    centre = numbers(where, "principalPoint", lens.get("principalPoint"), (2,))
    if version >= (1, 2, 1):
        centre = centre + np.array([width / 2, height / 2])
    given = numbers(where, "distortionParams", lens.get("distortionParams") or [], (0, len(order)))
    parameters = {"fx": fx, "fy": fy, "cx": centre[0] + HALF, "cy": centre[1] + HALF}
    parameters |= {key: float(value) for key, value in zip(order, given, strict=False)}
    return lens_camera(name, model, parameters, pose, (width, height), source=where)


def _focal(where: str, lens: Mapping[str, Any], width: int, version: tuple[int, ...]) -> tuple[float, float]:
    if version < (1, 2, 0):
        focal = number(where, lens, "pxFocalLength")
        return focal, focal
    if version < (1, 2, 2):
        fx, fy = numbers(where, "pxFocalLength", lens.get("pxFocalLength"), (2,))
        return float(fx), float(fy)
    fx = number(where, lens, "focalLength") / positive(where, lens, "sensorWidth", 36.0) * width
    ratio = positive(where, lens, "pixelRatio", 1.0)
    return fx, fx / ratio if version < (1, 2, 5) else fx * ratio


def _points(path: Path, document: Mapping[str, Any]) -> InitialPoints | None:
    points = list(_by_id(path, document, "structure", "landmarkId").values())
    if not points:
        return None
    places = np.array([numbers(str(path), "X of a landmark", point.get("X"), (3,)) for point in points])
    colours = np.array([numbers(str(path), "color of a landmark", point.get("color"), (3,)) for point in points])
    return InitialPoints(places, np.clip(colours / 255, 0, 1).astype(np.float32))
