"""Reads a folder with one OpenCV FileStorage file per camera, `<camera>.yml`, `.yaml` or `.xml`.

OpenCV defines no rig layout, so this layout uses the field names of its samples. As in the calibration sample, each
file has `camera_matrix` [3, 3], `distortion_coefficients`, `image_width`, `image_height` and, if true, `fisheye_model`.
As in the stereo sample, `R` ([3, 3] or a Rodrigues vector) and `T` [3] transform world to camera coordinates. Other
common names are also accepted. The sample's `extrinsic_parameters` are board poses, so they are not used.
(docs.opencv.org, "Camera calibration With OpenCV"; `samples/cpp/.../camera_calibration.cpp`.)
"""

from __future__ import annotations

import re
from pathlib import Path

from client.importers.calibration import Calibration, calibration_of_cameras
from client.importers.formats.easymocap import EXTRINSICS, INTRINSICS
from client.importers.formats.file_storage import first_field, read_storage, size_of_pictures
from client.importers.formats.opencv_camera import opencv_camera, picture_size
from client.importers.lens import LensCamera
from scas4d_core.captures import CaptureError

ENDS = (".yml", ".yaml", ".xml")
MATRIX = ("camera_matrix", "cameraMatrix", "K", "M")
DISTORTION = ("distortion_coefficients", "distCoeffs", "dist", "D")
ROTATION = ("R", "Rot", "rotation", "rvec")
TRANSLATION = ("T", "t", "translation", "tvec")
FIRST_BYTES = 200
MATRIX_FIELD = re.compile(rb"^\s*<?(" + "|".join(MATRIX).encode() + rb")\s*[ :>]", re.MULTILINE)


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
    stored = data.lstrip().startswith(b"%YAML") or b"<opencv_storage" in data[:FIRST_BYTES]
    return stored and MATRIX_FIELD.search(data) is not None


def read_opencv_files(folder: Path, capture: Path) -> Calibration:
    """Reads the rig from a folder with one file per camera.

    Args:
        folder: folder that contains the calibration files.
        capture: folder with `images/` or `videos/`, from which missing image sizes are read.

    Raises:
        CaptureError: if a field is missing or invalid. The message names the file, field and remedy.
        MissingExtraError: if OpenCV is not installed.
    """
    return calibration_of_cameras(folder, [_camera(path, capture) for path in camera_files(folder)])


def _camera(path: Path, capture: Path) -> LensCamera:
    stored, where = read_storage(path), str(path)
    rotation, translation = first_field(stored, ROTATION), first_field(stored, TRANSLATION)
    if rotation is None or translation is None:
        raise CaptureError(
            f"{path} has no pose; add R and T, world to camera (extrinsic_parameters in OpenCV's sample are board "
            "poses)"
        )
    size = [stored.get("image_width"), stored.get("image_height")]
    return opencv_camera(
        where,
        path.stem,
        matrix=first_field(stored, MATRIX),
        distortions=first_field(stored, DISTORTION),
        rotation=rotation,
        translation=translation,
        size=size_of_pictures(capture, path.stem, where) if None in size else picture_size(where, size),
        fisheye=stored.get("fisheye_model") in (1.0, "true", "1"),
    )
