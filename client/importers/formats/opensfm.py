"""Reads OpenSfM's `reconstruction.json`, which OpenDroneMap also writes.

The file lists reconstructions. Each has `cameras` (lens models), `shots` (images) and `points`. A shot has the
world-to-camera `rotation` (Rodrigues vector) and `translation`, with OpenCV's axes. Lens models are in normalized image
coordinates: the origin is the image centre, and the longer side is 1. A point (u, v) is therefore at
(width/2 + u·max(width, height), …) where the first pixel's centre is (0.5, 0.5). Distortions are polynomials of
OpenCV's form. `perspective` and `fisheye` have one `focal`, k1 and k2. `simple_radial`, `radial`, `brown` and
`fisheye_opencv` have `focal_x`, `focal_y`, `c_x` and `c_y`.
(opensfm.org/docs/geometry.html, "Geometric Models"; github.com/mapillary/OpenSfM, `opensfm/io.py`.)
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from client.importers.calibration import CalibratedImage, Calibration, calibration
from client.importers.formats.documents import number, short, table, whole
from client.importers.formats.opencv_camera import numbers, rodrigues
from client.importers.lens import FISHEYE, LensCamera, lens_camera
from scas4d_core.captures import CaptureError, InitialPoints
from scas4d_core.captures.files import read_json_value

PROJECTIONS = {
    "perspective": ("RADIAL", ("k1", "k2")),
    "simple_radial": ("RADIAL", ("k1",)),
    "radial": ("RADIAL", ("k1", "k2")),
    "brown": ("OPENCV", ("k1", "k2", "k3", "p1", "p2")),
    "fisheye": ("OPENCV_FISHEYE", ("k1", "k2")),
    "fisheye_opencv": ("OPENCV_FISHEYE", FISHEYE),
}
"""Model of `client.importers.lens.MODELS` and coefficients, keyed by `projection_type`."""


def is_opensfm(document: Any) -> bool:
    """Returns whether a parsed JSON file lists reconstructions."""
    return isinstance(document, list) and any(isinstance(one, dict) and "shots" in one for one in document)


def read_opensfm(path: Path) -> Calibration:
    """Reads the rig and the point cloud from a file. Of several reconstructions, the one with the most shots is read.

    Raises:
        CaptureError: if a field is missing or invalid. The message names the file, image, field and remedy.
    """
    document = read_json_value(path)
    if not is_opensfm(document):
        raise CaptureError(f"{path} contains no list of reconstructions with `shots`; align the images again")
    shots = [table(str(path), table(str(path), one, "a reconstruction").get("shots", {}), "shots") for one in document]
    index = max(range(len(shots)), key=lambda number: len(shots[number]))
    where = str(path) if len(shots) == 1 else f"{path}: reconstruction {index}"
    lenses = table(where, document[index].get("cameras"), "cameras")
    views = [_view(where, lenses, name, table(where, shot, name)) for name, shot in shots[index].items()]
    remarks = []
    if len(shots) > 1:
        sizes = ", ".join(f"{number} with {len(of)} images" for number, of in enumerate(shots))
        remarks = [
            f"{path.name}: found {len(shots)} reconstructions ({sizes}); using {index}, which has the most images"
        ]
    return calibration(path, views, points=_points(where, document[index].get("points") or {}), remarks=remarks)


def _view(where: str, lenses: Mapping[str, Any], name: str, shot: Mapping[str, Any]) -> CalibratedImage:
    where = f"{where}: shot {name!r}"
    camera = shot.get("camera")
    if not isinstance(camera, str) or camera not in lenses:
        raise CaptureError(f"{where}: camera {short(camera)} is not in cameras; export the reconstruction again")
    pose = np.eye(4)
    pose[:3, :3] = rodrigues(numbers(where, "rotation", shot.get("rotation"), (3,)))
    pose[:3, 3] = numbers(where, "translation", shot.get("translation"), (3,))
    return CalibratedImage(PurePosixPath(name.replace("\\", "/")), _lens(where, name, lenses[camera], pose))


def _lens(where: str, name: str, given: Any, pose: Any) -> LensCamera:
    lens = table(where, given, "its camera")
    projection = lens.get("projection_type", "perspective")
    if not isinstance(projection, str) or projection not in PROJECTIONS:
        raise CaptureError(
            f"{where}: unsupported projection_type {short(projection)}; calibrate with one of {', '.join(PROJECTIONS)}"
        )
    width, height = whole(where, lens, "width"), whole(where, lens, "height")
    side = max(width, height)
    model, coefficients = PROJECTIONS[projection]
    both = "focal" in lens
    parameters = {
        "fx": side * number(where, lens, "focal" if both else "focal_x"),
        "fy": side * number(where, lens, "focal" if both else "focal_y"),
        "cx": width / 2 + side * number(where, lens, "c_x", 0.0),
        "cy": height / 2 + side * number(where, lens, "c_y", 0.0),
        **{key: number(where, lens, key, 0.0) for key in coefficients},
    }
    return lens_camera(name, model, parameters, pose, (width, height), source=where)


def _points(where: str, given: Any) -> InitialPoints | None:
    points = [table(where, point, "a point") for point in table(where, given, "points").values()]
    if not points:
        return None
    places = np.array([numbers(where, "coordinates of a point", point.get("coordinates"), (3,)) for point in points])
    colours = np.array([numbers(where, "color of a point", point.get("color"), (3,)) for point in points])
    return InitialPoints(places, np.clip(colours / 255, 0, 1).astype(np.float32))
