"""Reads caliscope's `camera_array.toml`.

Each camera has a table `[cameras.<id>]` with `size` (width, height), `matrix` and `distortions` (5, or 4 if `fisheye`).
`rotation`, a matrix [3][3] or Rodrigues vector [3], and `translation` transform world to camera coordinates. Cameras
are named after their videos, `cam_<id>.mp4`, or `port_<id>.mp4` in earlier versions, which wrote `port` instead of
`cam_id`. `rotation_count` rotates images only for caliscope's trackers, not for the calibration, so it is ignored.
Cameras that are marked as ignored or have no pose are left out, and a remark lists them.
(github.com/mprib/caliscope, `src/caliscope/cameras/camera_array.py`.)
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from client.importers.calibration import Calibration, calibration_of_cameras
from client.importers.formats.opencv_camera import camera_of_table
from scas4d_core.captures import CaptureError


def is_caliscope(document: Mapping[str, Any]) -> bool:
    """Returns whether the file has a table of cameras."""
    return isinstance(document.get("cameras"), Mapping)


def read_caliscope(path: Path, document: Mapping[str, Any]) -> Calibration:
    """Reads the rig from a parsed file.

    Raises:
        CaptureError: if a field is missing or invalid. The message names the file, camera, field and remedy.
    """
    cameras, left_out = [], []
    for key, table in document["cameras"].items():
        where = f"{path}: [cameras.{key}]"
        if not isinstance(table, Mapping):
            raise CaptureError(f"{where} is not a camera table; remove it")
        name = f"{'port' if 'port' in table else 'cam'}_{table.get('cam_id', table.get('port', key))}"
        if table.get("ignore") is True or not _calibrated(table):
            left_out.append(name)
            continue
        cameras.append(camera_of_table(where, name, table))
    why = f"{path.name}: skipped cameras that are ignored or have no pose"
    return calibration_of_cameras(path, cameras, left_out, why)


def _calibrated(table: Mapping[str, Any]) -> bool:
    """Returns whether the camera has intrinsics and a pose. rtoml writes missing values as "null"."""
    return all(isinstance(table.get(field), list) for field in ("matrix", "rotation", "translation"))
