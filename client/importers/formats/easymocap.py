"""Reads EasyMocap's `intri.yml` and `extri.yml`, which are OpenCV FileStorage files. Requires PyYAML.

`names` lists the cameras. For each camera, `intri.yml` has `K_<name>` [3, 3], `dist_<name>` (or `D_<name>`) and, in
some versions, `H_<name>` and `W_<name>`. If the size is missing, it is read from the images. `extri.yml` has the
world-to-camera rotation `Rot_<name>` [3, 3], or only `R_<name>` [3] (Rodrigues vector), and translation `T_<name>` [3].
Cameras without a pose are left out, and a remark lists them.
(github.com/zju3dv/EasyMocap, `easymocap/mytools/camera_utils.py`.)
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from client.importers.calibration import Calibration, calibration_of_cameras
from client.importers.folders import size_of_pictures
from client.importers.formats.opencv_camera import numbers, opencv_camera, picture_size, rodrigues
from client.importers.formats.opencv_storage import first_field, read_storage
from client.importers.lens import LensCamera
from scas4d_core.captures import CaptureError

INTRINSICS, EXTRINSICS = "intri.yml", "extri.yml"
APART = 1e-3
"""Maximum difference per entry between the rotation matrix and the Rodrigues vector's. Files store six digits."""


def is_easymocap(folder: Path) -> bool:
    """Returns whether the folder contains both calibration files."""
    return all((folder / name).is_file() for name in (INTRINSICS, EXTRINSICS))


def read_easymocap(folder: Path, capture: Path) -> Calibration:
    """Reads the rig from a folder.

    Args:
        folder: folder that contains the two calibration files.
        capture: folder with `images/` or `videos/`, from which missing image sizes are read.

    Raises:
        CaptureError: if a file or field is missing or invalid. The message names it and the remedy.
        MissingExtraError: if PyYAML is not installed.
    """
    for name in (INTRINSICS, EXTRINSICS):
        if not (folder / name).is_file():
            raise CaptureError(f"{folder / name}: no such file; EasyMocap writes {INTRINSICS} and {EXTRINSICS}")
    intrinsics, extrinsics = read_storage(folder / INTRINSICS), read_storage(folder / EXTRINSICS)
    names = intrinsics.get("names")
    if not isinstance(names, list) or not names:
        raise CaptureError(f"{folder / INTRINSICS}: missing `names`, the list of cameras")
    texts = [name for name in names if isinstance(name, str)]
    posed = [name for name in texts if extrinsics.get(f"T_{name}") is not None]
    left_out = [name for name in texts if name not in posed and name != "none"]
    cameras = [_camera(folder, capture, name, intrinsics, extrinsics) for name in posed]
    why = f"{INTRINSICS}: skipped cameras that have no pose in {EXTRINSICS}"
    return calibration_of_cameras(folder, cameras, left_out, why)


def _camera(
    folder: Path, capture: Path, name: str, intrinsics: dict[str, Any], extrinsics: dict[str, Any]
) -> LensCamera:
    where = f"{folder / EXTRINSICS}: camera {name!r}"
    rotation, vector = extrinsics.get(f"Rot_{name}"), extrinsics.get(f"R_{name}")
    if rotation is None:
        rotation = vector
    elif vector is not None:
        matrix = numbers(where, f"Rot_{name}", rotation, (9,)).reshape(3, 3)
        if np.abs(rodrigues(numbers(where, f"R_{name}", vector, (3,))) - matrix).max() > APART:
            raise CaptureError(
                f"{where}: R_{name} and Rot_{name} are different rotations; export the calibration again"
            )
    where = f"{folder / INTRINSICS}: camera {name!r}"
    size = [intrinsics.get(f"{side}_{name}") for side in "WH"]
    return opencv_camera(
        where,
        name,
        matrix=intrinsics.get(f"K_{name}"),
        distortions=first_field(intrinsics, (f"dist_{name}", f"D_{name}")),
        rotation=rotation,
        translation=extrinsics.get(f"T_{name}"),
        size=size_of_pictures(capture, name, where) if None in size else picture_size(where, size),
    )
