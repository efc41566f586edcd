"""Reads anipose's `calibration.toml` (aniposelib), and the files of Pose2Sim and FreeMoCap, which have the same fields.

Each camera has a table with `name`, `size` (width, height), `matrix` [3][3] and `distortions` [5] or [4]. The table
also contains the world-to-camera `rotation` [3] (Rodrigues vector) and `translation` [3]. `fisheye = true` marks
coefficients of `cv2.fisheye`. Cameras without a pose are left out, and a remark lists them. `[metadata]` does not
describe the rig and is ignored. Anipose initializes the principal point to (width − 1)/2, which implies OpenCV's pixel
coordinates.
(github.com/lambdaloop/aniposelib, `aniposelib/cameras.py`; github.com/perfanalytics/pose2sim,
`Pose2Sim/calibration.py`.)
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from client.importers.calibration import Calibration, calibration_of_cameras
from client.importers.formats.opencv_camera import camera_of_table
from scas4d_core.captures import CaptureError

INTRINSICS_FOLDER = re.compile(r"int_(.+)_img")
"""Pattern of the folder names that Pose2Sim uses as camera names. The group is the name of the camera's videos."""


def is_anipose(document: Mapping[str, Any]) -> bool:
    """Returns whether any table in the file has a camera matrix."""
    return any(isinstance(table, Mapping) and "matrix" in table for table in document.values())


def read_anipose(path: Path, document: Mapping[str, Any]) -> Calibration:
    """Reads the rig from a parsed file.

    Raises:
        CaptureError: if a field is missing or invalid. The message names the file, camera, field and remedy.
    """
    cameras, left_out = [], []
    for key, table in document.items():
        if key == "metadata":
            continue
        if not isinstance(table, Mapping):
            raise CaptureError(f"{path}: {key} is not a camera table; remove it")
        name = table.get("name", key)
        if not isinstance(name, str | int):
            raise CaptureError(f"{path}: [{key}]: name must be a string; got {name!r}")
        inner = INTRINSICS_FOLDER.fullmatch(str(name))
        where = f"{path}: [{key}]"
        if table.get("rotation") is None and table.get("translation") is None:
            left_out.append(inner[1] if inner else str(name))
            continue
        cameras.append(camera_of_table(where, inner[1] if inner else str(name), table))
    return calibration_of_cameras(path, cameras, left_out, f"{path.name}: skipped cameras that have no pose")
