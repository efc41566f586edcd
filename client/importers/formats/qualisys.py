"""Reads Qualisys calibrations, exported from QTM as `*.qca.txt`: XML files that store all data in attributes.

Each camera has the attributes `active`, `serial` and `model`, and the following elements:

- `transform`: the camera's position x, y, z in millimetres, and its world-to-camera rotation r11 … r33 with OpenGL axes
  (x right, y up, z back). The position is converted to metres.
- `intrinsic`: focalLengthU, centerPointU, … in subpixels of the sensor, normally 64 per pixel. The actual number
  is `sensorMaxU` divided by the width of `fov_video_max`. `radialDistortion1` … and `tangentalDistortion1`, `2` are
  OpenCV's k1, k2, k3, p1, p2. Pose2Sim also divides these coefficients by 64. On its demo rig, however, they match a
  checkerboard calibration only without this division. There, k1 ranges from −0.046 to −0.048 in the file, and is
  −0.031, −0.047, −0.052 and −0.053 in the checkerboard calibration.
- `fov_video`: the recorded region of the sensor. Principal points are made relative to its corner.

The centre of the first pixel is assumed to be at (0, 0), as in Pose2Sim, because Qualisys does not specify it. Cameras
that record markers instead of video are left out, and a remark lists them.
(github.com/perfanalytics/pose2sim, `read_qca` and `calib_qca_fun` in `Pose2Sim/calibration.py`.)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from client.importers.calibration import Calibration, calibration_of_cameras
from client.importers.formats.documents import read_xml
from client.importers.formats.opencv_camera import opencv_camera, picture_size
from client.importers.lens import LensCamera
from scas4d_core.captures import CaptureError

Float = NDArray[np.float64]

END = ".qca.txt"
PARTS = ("transform", "intrinsic", "fov_video", "fov_video_max")
FLIP = np.diag([1.0, -1.0, -1.0])
"""Converts OpenGL's camera axes to OpenCV's."""
METRES = 1e-3
WHOLE = 0.1
"""Tolerance for rounding the subpixels per pixel. Real files have ratios such as 69568/1087 or 122879/1919."""


@dataclass
class _QualisysCamera:
    """The XML attributes of one camera and of its child elements."""

    own: Mapping[str, str]
    parts: dict[str, Mapping[str, str]] = field(default_factory=dict)


def read_qualisys(path: Path) -> Calibration:
    """Reads the rig from a `*.qca.txt`.

    Raises:
        CaptureError: if the file is not XML, or a field is missing or invalid. The message names the file, camera,
            field and remedy.
    """
    cameras = [camera for camera in _cameras(path) if camera.own.get("active", "1") not in ("0", "false")]
    video = [camera for camera in cameras if _films(camera)] or cameras
    markers = [camera.own.get("serial", "?") for camera in cameras if camera not in video]
    why = f"{path.name}: skipped cameras that record markers instead of video"
    return calibration_of_cameras(path, [_lens(path, camera) for camera in video], markers, why)


def _films(camera: _QualisysCamera) -> bool:
    model = camera.own.get("model", "none").lower()
    return "video" in model or model == "none"


def _cameras(path: Path) -> list[_QualisysCamera]:
    """Returns the cameras of the file."""
    cameras = [
        _QualisysCamera(camera.attrib, {part.tag: part.attrib for part in camera.iter() if part.tag in PARTS})
        for camera in read_xml(path).iter("camera")
    ]
    if not cameras:
        raise CaptureError(f"{path} contains no cameras; export the calibration from QTM as text (*.qca.txt)")
    return cameras


def _lens(path: Path, camera: _QualisysCamera) -> LensCamera:
    name = camera.own.get("serial", "")
    where = f"{path}: camera {name!r}"

    def number(part: str, key: str) -> float:
        given = camera.parts.get(part, {}).get(key)
        try:
            value = float(given) if given is not None else np.nan
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            raise CaptureError(f"{where}: {key} of {part} must be a finite number; got {given!r}")
        return value

    window = "fov_video_max" if "fov_video_max" in camera.parts else "fov_video"
    unit: list[float] = []
    for axis, low, high in (("U", "left", "right"), ("V", "top", "bottom")):
        sensor = number("intrinsic", f"sensorMax{axis}") - number("intrinsic", f"sensorMin{axis}")
        pixels = number(window, high) - number(window, low)
        ratio = sensor / pixels if pixels > 0 else 0.0
        if round(ratio) < 2 or abs(ratio - round(ratio)) > WHOLE or round(ratio) != (unit or [round(ratio)])[0]:
            raise CaptureError(
                f"{where}: sensorMax{axis} is {sensor:g} for the {pixels + 1:g} pixels of {window}, i.e. {ratio:.3g} "
                "subpixels per pixel instead of QTM's 64; export the calibration from QTM"
            )
        unit.append(float(round(ratio)))
    corner = np.array([number("fov_video", "left"), number("fov_video", "top")])
    size = (number("fov_video", "right") - corner[0] + 1, number("fov_video", "bottom") - corner[1] + 1)
    matrix = np.eye(3)
    matrix[0, 0], matrix[1, 1] = (number("intrinsic", f"focalLength{a}") / u for a, u in zip("UV", unit, strict=True))
    matrix[:2, 2] = [number("intrinsic", f"centerPoint{a}") / u for a, u in zip("UV", unit, strict=True)] - corner
    matrix[0, 1] = number("intrinsic", "skew") / unit[0]
    radial = [number("intrinsic", f"radialDistortion{i}") for i in (1, 2, 3)]
    tangential = [number("intrinsic", f"tangentalDistortion{i}") for i in (1, 2)]
    rotation = FLIP @ [[number("transform", f"r{row}{column}") for column in (1, 2, 3)] for row in (1, 2, 3)]
    place = METRES * np.array([number("transform", axis) for axis in "xyz"])
    return opencv_camera(
        where,
        name,
        matrix=matrix,
        distortions=[*radial[:2], *tangential, radial[2]],
        rotation=rotation,
        translation=-rotation @ place,
        size=picture_size(where, size),
    )
