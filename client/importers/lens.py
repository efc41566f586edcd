"""Camera models of calibration tools, and cameras with lens distortion. Requires only numpy.

In pixel coordinates, the centre of the first pixel is at (0.5, 0.5), as in COLMAP and nerfstudio.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Camera, CameraError
from scas4d_core.captures import CaptureError

Float = NDArray[np.float64]

PERSPECTIVE = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Coefficients in OpenCV's order. The radial factor is (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)."""
FISHEYE = ("k1", "k2", "k3", "k4")
"""Fisheye coefficients: θ_d = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)."""

MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
"""Supported camera models, with their parameters in COLMAP's order."""


@dataclass(frozen=True, eq=False)
class LensCamera:
    """A calibrated camera with lens distortion.

    Attributes:
        name: camera name, unique within its rig.
        model: camera model, one of `MODELS`.
        intrinsics: [3, 3] in pixels, with the principal point relative to the upper left corner of the image.
        distortion: coefficients in OpenCV's order, [8] as in `PERSPECTIVE` or [4] as in `FISHEYE`.
        world_to_camera: [4, 4] pose matrix with OpenCV axes.
        width, height: image size in pixels.
    """

    name: str
    model: str
    intrinsics: Float
    distortion: Float
    world_to_camera: Float
    width: int
    height: int

    @property
    def fisheye(self) -> bool:
        """Whether the distortion is a function of the angle from the optical axis."""
        return self.model == "OPENCV_FISHEYE"

    @property
    def is_pinhole(self) -> bool:
        """Whether the camera is a pinhole camera. A fisheye with zero coefficients is not a pinhole camera."""
        return not self.fisheye and not self.distortion.any()

    def pinhole(self, intrinsics: Float | None = None) -> Camera:
        """Returns a pinhole camera with the same pose, and with the given intrinsics or those of the lens.

        Raises:
            CameraError: if the camera is not valid.
        """
        k = self.intrinsics if intrinsics is None else intrinsics
        return Camera(self.name, k, self.world_to_camera, self.width, self.height)


def lens_camera(
    name: str,
    model: str,
    parameters: Mapping[str, float],
    world_to_camera: Float,
    size: tuple[int, int],
    *,
    source: str,
) -> LensCamera:
    """Creates and validates a camera from the named parameters of its model (`MODELS`).

    Args:
        name: camera name.
        model: camera model.
        parameters: parameter values, keyed by name. Models with a single focal length also accept `fx` and `fy`.
            Missing coefficients are 0.
        world_to_camera: [4, 4] pose matrix with OpenCV axes.
        size: (width, height) in pixels.
        source: file name, for messages.

    Raises:
        CaptureError: if the model is not supported, or the camera is not valid.
    """
    if model not in MODELS:
        raise CaptureError(
            f"{source}: camera {name!r} has the unsupported model {model}; calibrate with one of {', '.join(MODELS)}"
        )
    known = {*MODELS[model], "fx", "fy"} | ({"k3"} if model == "OPENCV" else set())
    strange = {key: value for key, value in parameters.items() if key not in known and value != 0}
    if strange:
        listed = ", ".join(f"{key} = {value:g}" for key, value in strange.items())
        raise CaptureError(
            f"{source}: camera {name!r} has {listed}, which model {model} does not support; use FULL_OPENCV"
        )
    focal = {key: parameters.get(key, parameters.get("f", 0.0)) for key in ("fx", "fy")}
    intrinsics = np.array(
        [[focal["fx"], 0, parameters["cx"]], [0, focal["fy"], parameters["cy"]], [0, 0, 1]], dtype=np.float64
    )
    order = FISHEYE if model == "OPENCV_FISHEYE" else PERSPECTIVE
    distortion = np.array([parameters.get(key, 0.0) for key in order], dtype=np.float64)
    if not np.isfinite(distortion).all():
        listed = ", ".join(key for key, value in zip(order, distortion, strict=True) if not np.isfinite(value))
        raise CaptureError(f"{source}: camera {name!r}: {listed} must be finite; got NaN or infinity")
    camera = LensCamera(name, model, intrinsics, distortion, np.asarray(world_to_camera, np.float64), *size)
    try:
        camera.pinhole()
    except CameraError as fault:
        raise CaptureError(f"{source}: {fault}") from fault
    return camera
