"""The calibration in the report of frame 0, and the refined rig read from it. Numpy only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import nan
from typing import Any

import numpy as np

from scas4d_core.cameras import Camera, Rig


@dataclass(frozen=True)
class CameraResidual:
    """Distance of a camera's matches from the calibration.

    Attributes:
        pixels: median distance from the epipolar lines, in pixels of the camera's pictures; NaN where too few matches
            determine it. matches: how many are right, about.
    """

    pixels: float
    matches: int


@dataclass(frozen=True)
class RefinedCamera:
    """A camera after refinement.

    Attributes:
        rotation_deg: degrees. translation: of its centre, in the user's unit. focal: times its focal length as given.
        before, after: its residual, pixels; NaN with too few matches. fixed: left as given for want of matches.
        pose: [4][4] world to camera, the user's world.
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
    """The outcome of refining a calibration.

    Attributes:
        accepted: the scene has the refined rig. text: for people, why or why not.
        before, after: distance from the epipolar lines, pixels, at which a match has the mean loss of those held out.
        matches: held out.
        cameras: by name; none where it was not accepted.
    """

    accepted: bool
    text: str
    before: float = nan
    after: float = nan
    matches: int = 0
    cameras: dict[str, RefinedCamera] = field(default_factory=dict)

    def apply_to(self, camera: Camera) -> Camera:
        """The camera, of any size, as it was refined."""
        refined_camera = self.cameras.get(camera.name)
        return camera if refined_camera is None else _with_pose(camera, refined_camera.pose, refined_camera.focal)


@dataclass(frozen=True)
class CalibrationReport:
    """The calibration against the pictures of frame 0.

    Attributes:
        cameras: residual of each as it was given, by name. miscalibrated: names of those that are clearly off.
        warnings: what a person should know, a sentence each; of the refined rig where there is one.
        refined: where that was asked for.
    """

    cameras: dict[str, CameraResidual]
    miscalibrated: list[str]
    warnings: list[str]
    refined: Refinement | None = None


def effective_rig(rig: Rig, record: Mapping[str, Any]) -> Rig:
    """The rig that a scene was begun with: with refined cameras where frame 0 has accepted them.

    Args:
        rig: as given, of any size, or of some of its cameras. record: of frame 0, as ``History.report`` gives it.

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
