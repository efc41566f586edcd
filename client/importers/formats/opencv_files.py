"""Reads a folder with one file per camera in OpenCV's FileStorage or in ROS's `camera_info` format.

Files are `<camera>.yml`, `.yaml`, `.xml` or `.json`. OpenCV defines no rig layout, so this layout uses the field names
of its samples. As in the calibration sample, each file has `camera_matrix` [3, 3], `distortion_coefficients`,
`image_width`, `image_height` and, if true, `fisheye_model`. As in the stereo sample, `R` ([3, 3] or a Rodrigues vector)
and `T` [3] transform world to camera coordinates. Other common names are also accepted. The sample's
`extrinsic_parameters` are board poses, so they are not used.

ROS's files have the same intrinsics, and `distortion_model`: `plumb_bob`, `rational_polynomial`, or `equidistant` for
OpenCV's fisheye. They contain no pose in a rig, so `R` and `T` must be added.
(docs.opencv.org, "Camera calibration With OpenCV"; `samples/cpp/.../camera_calibration.cpp`; wiki.ros.org,
"camera_calibration_parsers"; `sensor_msgs/CameraInfo`.)
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from client.importers.calibration import Calibration, calibration_of_cameras
from client.importers.folders import size_of_pictures
from client.importers.formats.documents import json_value
from client.importers.formats.easymocap import EXTRINSICS, INTRINSICS
from client.importers.formats.opencv_camera import opencv_camera, picture_size
from client.importers.formats.opencv_storage import first_field, read_storage
from client.importers.lens import LensCamera
from scas4d_core.captures import CaptureError

ENDS = (".yml", ".yaml", ".xml", ".json")
MATRIX = ("camera_matrix", "cameraMatrix", "K", "M")
DISTORTION = ("distortion_coefficients", "distCoeffs", "dist", "D")
ROTATION = ("R", "Rot", "rotation", "rvec")
TRANSLATION = ("T", "t", "translation", "tvec")
FISHEYE_MODELS = ("equidistant", "fisheye", "kannala_brandt4")
PERSPECTIVE_MODELS = ("plumb_bob", "rational_polynomial", "radtan")
NAMES = "|".join(MATRIX).encode()
YAML_MATRIX = re.compile(rb"^(" + NAMES + rb")\s*:\s*(!!opencv-matrix|\[|(rows|cols|data)\s*:|-)", re.MULTILINE)
XML_MATRIX = re.compile(rb"<opencv_storage.*<(" + NAMES + rb")[ >]", re.DOTALL)


def camera_files(folder: Path) -> list[Path]:
    """Returns the files in a folder that contain the matrix of a single camera. EasyMocap's files are excluded."""
    if not folder.is_dir():
        return []
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in ENDS and path.is_file())
    return [path for path in files if path.name not in (INTRINSICS, EXTRINSICS) and _is_camera(path)]


def _is_camera(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            data = file.read(1 << 20)
    except OSError:
        return False
    if path.suffix.lower() != ".json":
        return (XML_MATRIX if path.suffix.lower() == ".xml" else YAML_MATRIX).search(data) is not None
    document = json_value(path, *(f'"{name}"' for name in MATRIX))
    return isinstance(document, dict) and first_field(document, MATRIX) is not None


def read_opencv_files(folder: Path, capture: Path) -> Calibration:
    """Reads the rig from a folder with one file per camera. Cameras without a pose are left out with a remark.

    Args:
        folder: folder that contains the calibration files.
        capture: folder with `images/` or `videos/`, from which missing image sizes are read.

    Raises:
        CaptureError: if a field is missing or invalid, or no file contains a pose. The message names the file, field
            and remedy.
        MissingExtraError: if a file is YAML, and PyYAML is not installed.
    """
    files = camera_files(folder)
    stored = {path: read_storage(path) for path in files}
    posed = [path for path in files if first_field(stored[path], ROTATION + TRANSLATION) is not None]
    if not posed:
        raise CaptureError(
            f"{files[0]} has no pose, nor has any other file in {folder}; add R and T, world to camera "
            "(extrinsic_parameters in OpenCV's sample are board poses, and ROS's camera_info contains none)"
        )
    left_out = [path.stem for path in files if path not in posed]
    cameras = [_camera(path, stored[path], capture) for path in posed]
    return calibration_of_cameras(folder, cameras, left_out, "skipped cameras whose file contains no pose (R and T)")


def _camera(path: Path, stored: Mapping[str, Any], capture: Path) -> LensCamera:
    where = str(path)
    size = [stored.get("image_width"), stored.get("image_height")]
    model = stored.get("distortion_model")
    if model not in (None, "", *FISHEYE_MODELS, *PERSPECTIVE_MODELS):
        raise CaptureError(
            f"{path}: unsupported distortion_model {model!r}; calibrate with one of "
            f"{', '.join((*PERSPECTIVE_MODELS, FISHEYE_MODELS[0]))}"
        )
    return opencv_camera(
        where,
        path.stem,
        matrix=first_field(stored, MATRIX),
        distortions=first_field(stored, DISTORTION),
        rotation=first_field(stored, ROTATION),
        translation=first_field(stored, TRANSLATION),
        size=size_of_pictures(capture, path.stem, where) if None in size else picture_size(where, size),
        fisheye=model in FISHEYE_MODELS or str(stored.get("fisheye_model")).lower() in ("1", "1.0", "true"),
    )
