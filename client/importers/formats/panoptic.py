"""Reads `calibration_*.json` of the CMU Panoptic data set.

Each entry of `cameras` has `name` (`00_12`), `type` (`hd`, `vga`, `kinect-color`), `resolution` (width, height), `K`
[3, 3], `distCoef` [5] in OpenCV's order, and the world-to-camera `R` [3, 3] and `t` [3, 1], in centimetres. The axes
are OpenCV's, as the toolbox projects with the formula of `cv2.projectPoints`. It does not specify the coordinate of
the first pixel's centre. (0.5, 0.5) is assumed here, because Dynamic3DGaussians renders this data set with `K`
unchanged. Images are in `hdImgs/<name>/<name>_<frame>.jpg`, and videos in `hdVideos/hd_<name>.mp4`. Most downloads
contain only some of the 521 cameras.
(github.com/CMU-Perceptual-Computing-Lab/panoptic-toolbox, `python/panutils.py`, README.)
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from client.importers.calibration import Calibration, calibration_of_cameras
from client.importers.formats.documents import table
from client.importers.formats.opencv_camera import opencv_camera, picture_size
from scas4d_core.captures import CaptureError
from scas4d_core.captures.files import read_json

FIRST_PIXEL = 0.5


def is_panoptic(document: Any) -> bool:
    """Returns whether a parsed JSON file lists cameras with K, R and t."""
    cameras = document.get("cameras") if isinstance(document, dict) else None
    return isinstance(cameras, list) and any(isinstance(one, dict) and {"K", "R", "t"} <= one.keys() for one in cameras)


def read_panoptic(path: Path) -> Calibration:
    """Reads the rig from a `calibration_*.json`.

    Raises:
        CaptureError: if a field is missing or invalid. The message names the file, camera, field and remedy.
    """
    cameras, left_out = [], []
    for index, entry in enumerate(read_json(path)["cameras"]):
        camera = table(str(path), entry, f"cameras[{index}]")
        name = camera.get("name")
        if not isinstance(name, str) or not name:
            raise CaptureError(f"{path}: cameras[{index}]: name must be a string; got {name!r}")
        if camera.get("R") is None or camera.get("t") is None:
            left_out.append(name)
            continue
        where = f"{path}: camera {name!r}"
        cameras.append(
            opencv_camera(
                where,
                name,
                matrix=camera.get("K"),
                distortions=camera.get("distCoef"),
                rotation=camera["R"],
                translation=camera["t"],
                size=picture_size(where, camera.get("resolution")),
                first_pixel=FIRST_PIXEL,
            )
        )
    return calibration_of_cameras(path, cameras, left_out, f"{path.name}: skipped cameras that have no pose")
