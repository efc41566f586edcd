"""Reads anipose's `calibration.toml` (aniposelib), and Pose2Sim's and FreeMoCap's files, which have the same fields.

A table a camera: `name`, `size` (width, height), `matrix` [3][3], `distortions` [5] or [4], `rotation` [3] (Rodrigues'
vector) and `translation` [3], world to camera; `fisheye = true` for coefficients of `cv2.fisheye`. `[metadata]` says
nothing of the rig. Anipose starts from (width − 1)/2 as the principal point: OpenCV's pixels.
(github.com/lambdaloop/aniposelib, `aniposelib/cameras.py`; github.com/perfanalytics/pose2sim,
`Pose2Sim/calibration.py`.)
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from client.importers.calibration import Calibration, calibration_of_cameras
from client.importers.formats.opencv_camera import opencv_camera, picture_size
from scas4d_core.captures import CaptureError

INTRINSICS_FOLDER = re.compile(r"int_(.+)_img")
"""Pose2Sim names a camera by the folder of its calibration pictures; its videos are called by what is within."""


def is_anipose(document: Mapping[str, Any]) -> bool:
    """True where a table of the file has a camera's matrix and pose."""
    return any(isinstance(table, Mapping) and {"matrix", "rotation"} <= table.keys() for table in document.values())


def read_anipose(path: Path, document: Mapping[str, Any]) -> Calibration:
    """Reads the rig of a parsed file.

    Raises:
        CaptureError: a field is missing or cannot be; the message names file, camera, field and remedy.
    """
    cameras = []
    for key, table in document.items():
        if key == "metadata":
            continue
        if not isinstance(table, Mapping):
            raise CaptureError(f"{path}: {key} is not the table of a camera; leave it out")
        name = table.get("name", key)
        if not isinstance(name, str | int):
            raise CaptureError(f"{path}: [{key}] has the name {name!r}; give text")
        inner = INTRINSICS_FOLDER.fullmatch(str(name))
        where = f"{path}: [{key}]"
        cameras.append(
            opencv_camera(
                where,
                inner[1] if inner else str(name),
                matrix=table.get("matrix"),
                distortions=table.get("distortions"),
                rotation=table.get("rotation"),
                translation=table.get("translation"),
                size=picture_size(where, table.get("size")),
                fisheye=table.get("fisheye") is True,
            )
        )
    return calibration_of_cameras(path, cameras)
