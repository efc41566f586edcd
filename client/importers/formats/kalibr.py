"""Reads Kalibr's `camchain.yaml`. Requires PyYAML.

Each camera `cam0`, `cam1`, … has `camera_model`, `intrinsics`, `distortion_model`, `distortion_coeffs` and `resolution`
(width, height). `T_cn_cnm1` [4, 4] transforms from the camera before it, so `cam0` is the world. The model `pinhole`
(fu, fv, pu, pv) is read with the distortion `radtan` (OpenCV's k1, k2, p1, p2), `equidistant` (OpenCV's fisheye) or
`none`. As Kalibr detects targets with OpenCV, the first pixel is centred at (0, 0). If a transform is missing, that
camera and the ones after it are left out, and a remark lists them.
(github.com/ethz-asl/kalibr, wiki "Supported models", "Yaml formats".)
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from client.importers.calibration import Calibration, calibration_of_cameras, natural
from client.importers.formats.documents import read_yaml, table
from client.importers.formats.opencv_camera import numbers, opencv_camera, picture_size
from scas4d_core.captures import CaptureError

FIELD = "distortion_coeffs:"
DISTORTIONS = ("radtan", "equidistant", "none")


def is_kalibr(path: Path) -> bool:
    """Returns whether a YAML file has a field that only Kalibr uses. The file is not parsed."""
    if path.suffix.lower() not in (".yaml", ".yml"):
        return False
    try:
        with path.open("rb") as file:
            text = file.read(1 << 16)
    except OSError:
        return False
    return FIELD.encode() in text and b"camera_model:" in text


def read_kalibr(path: Path) -> Calibration:
    """Reads the rig from a `camchain.yaml`.

    Raises:
        CaptureError: if a field is missing or invalid. The message names the file, camera, field and remedy.
        MissingExtraError: if PyYAML is not installed.
    """
    document = table(str(path), read_yaml(path), "the document")
    names = sorted((key for key in document if str(key).startswith("cam")), key=natural)
    cameras, pose = [], np.eye(4)
    for index, name in enumerate(names):
        where = f"{path}: {name}"
        camera = table(where, document[name], "the camera")
        if index:
            if camera.get("T_cn_cnm1") is None:
                break
            pose = numbers(where, "T_cn_cnm1", camera["T_cn_cnm1"], (16,)).reshape(4, 4) @ pose
        cameras.append(_camera(where, name, camera, pose))
    left_out = names[len(cameras) :]
    why = f"{path.name}: skipped cameras that no T_cn_cnm1 connects with cam0"
    return calibration_of_cameras(path, cameras, left_out, why)


def _camera(where: str, name: str, camera: Mapping[str, Any], pose: Any) -> Any:
    model, distortion = camera.get("camera_model"), camera.get("distortion_model")
    if model != "pinhole" or distortion not in DISTORTIONS:
        raise CaptureError(
            f"{where}: unsupported camera_model {model!r} with distortion_model {distortion!r}; calibrate with pinhole "
            f"and one of {', '.join(DISTORTIONS)}"
        )
    fu, fv, pu, pv = numbers(where, "intrinsics", camera.get("intrinsics"), (4,))
    return opencv_camera(
        where,
        name,
        matrix=[[fu, 0, pu], [0, fv, pv], [0, 0, 1]],
        distortions=None if distortion == "none" else camera.get("distortion_coeffs"),
        rotation=pose[:3, :3],
        translation=pose[:3, 3],
        size=picture_size(where, camera.get("resolution")),
        fisheye=distortion == "equidistant",
    )
