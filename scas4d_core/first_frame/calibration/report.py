"""Calibration results in the report of frame 0, and the refined rig that the report describes.

This module requires only NumPy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import nan
from typing import Any

import numpy as np

from scas4d_core.cameras import Camera, Rig


@dataclass(frozen=True)
class CameraResidual:
    """Calibration error of a camera, estimated from its matches.

    Attributes:
        pixels: median epipolar distance, in pixels of the camera's images, or NaN if there are too
            few matches.
        matches: approximate number of correct matches.
    """

    pixels: float
    matches: int


@dataclass(frozen=True)
class RefinedCamera:
    """Camera after refinement.

    Attributes:
        rotation_deg: rotation from the given pose, in degrees.
        translation: displacement of the camera centre, in the user's units.
        focal: factor applied to the given focal length.
        before: residual before refinement in pixels, or NaN if there are too few matches.
        after: residual after refinement in pixels, or NaN if there are too few matches.
        fixed: whether the camera was left unchanged because it had too few matches.
        pose: [4][4] world-to-camera transform, in the user's world.
    """

    rotation_deg: float
    translation: float
    focal: float
    before: float
    after: float
    fixed: bool
    pose: list[list[float]]


@dataclass(frozen=True)
class Refinement:
    """Result of refining a calibration.

    Attributes:
        accepted: whether the scene uses the refined rig.
        text: user-facing explanation.
        before: error before refinement, in pixels. The error is the epipolar distance whose loss
            equals the mean loss of the held-out matches.
        after: error after refinement, in pixels.
        matches: number of held-out matches.
        cameras: refined cameras, keyed by name. The mapping is empty if the refinement was not
            accepted.
    """

    accepted: bool
    text: str
    before: float = nan
    after: float = nan
    matches: int = 0
    cameras: dict[str, RefinedCamera] = field(default_factory=dict)

    def apply_to(self, camera: Camera) -> Camera:
        """Returns a camera, at any image size, with its refined pose and focal length.

        A camera that was not refined is returned unchanged.
        """
        refined_camera = self.cameras.get(camera.name)
        return camera if refined_camera is None else _with_pose(camera, refined_camera.pose, refined_camera.focal)


@dataclass(frozen=True)
class CalibrationReport:
    """Result of checking the calibration against the images of frame 0.

    Attributes:
        cameras: residual of each camera before refinement, keyed by name.
        miscalibrated: names of cameras that are clearly off.
        warnings: user-facing warnings. If a refinement was accepted, the warnings describe the
            refined rig.
        refined: result of the refinement, or None if no refinement was requested.
    """

    cameras: dict[str, CameraResidual]
    miscalibrated: list[str]
    warnings: list[str]
    refined: Refinement | None = None


def effective_rig(rig: Rig, record: Mapping[str, Any]) -> Rig:
    """Returns the rig that a scene uses, with refined cameras if a refinement was accepted in frame 0.

    Args:
        rig: calibrated rig at any image size, or a subset of its cameras.
        record: report of frame 0, as returned by ``History.report``.

    >>> camera = Camera("front", [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4), 64, 48)
    >>> pose = np.eye(4)
    >>> pose[0, 3] = 0.5
    >>> record = {"calibration": {"refined": {"accepted": True, "cameras": {"front": {"pose": pose, "focal": 1.01}}}}}
    >>> refined = effective_rig(Rig((camera,)), record)["front"]
    >>> refined.centre, refined.fx
    (array([-0.5,  0. ,  0. ]), 101.0)
    >>> effective_rig(Rig((camera,)), {})["front"] is camera
    True
    """
    refined = (record.get("calibration") or {}).get("refined") or {}
    if not refined.get("accepted"):
        return rig
    cameras = refined["cameras"]
    return Rig(
        tuple(
            _with_pose(camera, cameras[camera.name]["pose"], cameras[camera.name]["focal"])
            if camera.name in cameras
            else camera
            for camera in rig.cameras
        )
    )


def _with_pose(camera: Camera, pose: Any, focal: float) -> Camera:
    intrinsics = camera.intrinsics.copy()
    intrinsics[0, 0] *= focal
    intrinsics[1, 1] *= focal
    return Camera(camera.name, intrinsics, np.array(pose, np.float64), camera.width, camera.height)
