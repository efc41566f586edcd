"""Undoes distortion and fisheye with OpenCV: from a lens to a pinhole camera of the same place and picture size.

The pinhole looks at the largest part of the picture, of the picture's own shape, in which every pixel was seen: no
black corners. Its pixels are as square as the lens's, its principal point follows.

OpenCV puts the centre of the first pixel at (0, 0), we and COLMAP at (0.5, 0.5): principal points lose half a pixel on
their way to it. Left out, the picture would lie half a pixel beside its camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.importers.extras import opencv
from client.importers.lens import LensCamera
from scas4d_core.cameras import Camera
from scas4d_core.captures import CaptureError

Float = NDArray[np.float64]
Picture = NDArray[np.uint8]

WIDEST_DEGREES = 120.0
"""A pinhole's field at most: beyond, a fisheye's picture is stretched over pixels that hold nothing."""
BORDER_POINTS = 64
TOLERANCE_PIXELS = 0.01
"""Farthest that a point of the border may come back from where it was: beyond, the lens cannot be undone there."""
HALF = 0.5


@dataclass(frozen=True, eq=False)
class Undistorter:
    """Undistorts the pictures of one camera. A straight lens needs nothing, and no OpenCV.

    Args:
        lens: as calibrated.

    Raises:
        CaptureError: the distortion cannot be undone within the picture.
        MissingExtra: OpenCV is needed and not there.
    """

    lens: LensCamera

    @cached_property
    def camera(self) -> Camera:
        """The pinhole camera that the undistorted picture belongs to."""
        if self.lens.straight:
            return self.lens.pinhole()
        return self.lens.pinhole(_inscribed(self.lens))

    @cached_property
    def _maps(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        cv2 = opencv()
        size = (self.lens.width, self.lens.height)
        to, given = _shifted(self.camera.intrinsics), _shifted(self.lens.intrinsics)
        make = cv2.fisheye.initUndistortRectifyMap if self.lens.fisheye else cv2.initUndistortRectifyMap
        maps: tuple[NDArray[np.float32], NDArray[np.float32]] = make(
            given, self.lens.distortion, np.eye(3), to, size, cv2.CV_32FC1
        )
        return maps

    @cached_property
    def valid(self) -> NDArray[np.bool_]:
        """Mask [H, W] of the undistorted pixels that the camera saw."""
        if self.lens.straight:
            return np.ones((self.lens.height, self.lens.width), dtype=bool)
        u, v = self._maps  # of OpenCV: the picture's edges are at −0.5 and size − 0.5
        inside = (u >= -HALF) & (u <= self.lens.width - HALF) & (v >= -HALF) & (v <= self.lens.height - HALF)
        return np.asarray(inside)

    def picture(self, picture: Picture) -> Picture:
        """Undistorts a picture: [H, W, 3] of the lens to [H, W, 3] of the pinhole camera.

        Lanczos: painted dots land within 0.02 pixels of where they belong; cubic interpolation moves them by up to
        0.08 and linear blurs.
        """
        return self._remapped(picture, "INTER_LANCZOS4")

    def mask(self, mask: Picture) -> Picture:
        """Undistorts a mask of labels [H, W]; each pixel takes the nearest one's."""
        return self._remapped(mask, "INTER_NEAREST")

    def _remapped(self, picture: Picture, how: str) -> Picture:
        if picture.shape[:2] != (self.lens.height, self.lens.width):
            raise CaptureError(
                f"camera {self.lens.name!r}: a picture of {picture.shape[1]}x{picture.shape[0]}, but calibrated for "
                f"{self.lens.width}x{self.lens.height}"
            )
        if self.lens.straight:
            return picture
        cv2 = opencv()
        result: Picture = cv2.remap(picture, *self._maps, getattr(cv2, how), borderMode=cv2.BORDER_REPLICATE)
        return result


def _shifted(intrinsics: Float) -> Float:
    """The same intrinsics for OpenCV's pixel centres, which are at whole numbers."""
    shifted = intrinsics.copy()
    shifted[:2, 2] -= HALF
    return shifted


def _inscribed(lens: LensCamera) -> Float:
    """Intrinsics of the pinhole whose whole picture the lens saw."""
    left, top, right, bottom = _seen_rectangle(lens)
    fx, fy = lens.intrinsics[0, 0], lens.intrinsics[1, 1]
    # One factor for both focal lengths keeps the pixels' shape.
    factor = max(lens.width / ((right - left) * fx), lens.height / ((bottom - top) * fy))
    k = np.diag([factor * fx, factor * fy, 1.0])
    k[0, 2] = lens.width / 2 - k[0, 0] * (left + right) / 2
    k[1, 2] = lens.height / 2 - k[1, 1] * (top + bottom) / 2
    return k


def _seen_rectangle(lens: LensCamera) -> tuple[float, float, float, float]:
    """Left, top, right, bottom at distance 1 of a rectangle that lies within what the lens saw.

    No edge of the picture, bent as it is, comes into the rectangle: it ends where each edge's innermost point lies.
    """
    x, y = (np.linspace(0, length, BORDER_POINTS) for length in (lens.width, lens.height))
    edges = {
        "left": np.stack([np.zeros_like(y), y], axis=-1),
        "top": np.stack([x, np.zeros_like(x)], axis=-1),
        "right": np.stack([np.full_like(y, lens.width), y], axis=-1),
        "bottom": np.stack([x, np.full_like(x, lens.height)], axis=-1),
    }
    rays = {side: straightened(lens, pixels, f"its {side} edge") for side, pixels in edges.items()}
    limit = np.tan(np.radians(WIDEST_DEGREES / 2))
    left, top = max(rays["left"][:, 0].max(), -limit), max(rays["top"][:, 1].max(), -limit)
    right, bottom = min(rays["right"][:, 0].min(), limit), min(rays["bottom"][:, 1].min(), limit)
    if not (left < right and top < bottom):
        raise CaptureError(
            f"camera {lens.name!r}: undistorted, nothing is left of its picture (from {left:.3g}, {top:.3g} to "
            f"{right:.3g}, {bottom:.3g} at distance 1); check its principal point and coefficients"
        )
    return left, top, right, bottom


def straightened(lens: LensCamera, pixels: Float, where: str) -> Float:
    """[P, 2] pixels of the lens to rays (x/z, y/z) [P, 2]; ±infinity beyond 89° from the axis of a fisheye.

    Raises:
        CaptureError: a pixel has no ray: the polynomial turns back before it.
    """
    distorted = (pixels - lens.intrinsics[:2, 2]) / lens.intrinsics.diagonal()[:2]
    if lens.fisheye:
        return _from_angles(lens, distorted, where)
    cv2 = opencv()
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-12)
    arguments: tuple[Any, ...] = (np.eye(3), lens.distortion)
    rays: Float = cv2.undistortPoints(distorted[:, None], *arguments, criteria=criteria)[:, 0]
    points = np.concatenate([rays, np.ones((len(rays), 1))], axis=-1)
    again = cv2.projectPoints(points[:, None], np.zeros(3), np.zeros(3), *arguments)[0][:, 0]
    missed = np.abs(again - distorted) @ lens.intrinsics.diagonal()[:2]
    _reached(lens, missed, where)
    _rising(lens, rays, where)
    return rays


def _from_angles(lens: LensCamera, distorted: Float, where: str) -> Float:
    radius = np.linalg.norm(distorted, axis=-1)
    powers = np.arange(3, 11, 2)
    angle = np.minimum(radius, np.pi)
    for _ in range(50):  # Newton
        value = angle + angle[:, None] ** powers @ lens.distortion
        slope = 1 + angle[:, None] ** (powers - 1) @ (powers * lens.distortion)
        angle = np.clip(angle - (value - radius) / np.where(np.abs(slope) > 1e-9, slope, 1e-9), 0, np.pi)
    missed = np.abs(angle + angle[:, None] ** powers @ lens.distortion - radius) * lens.intrinsics[0, 0]
    _reached(lens, missed, where)
    to_there = np.linspace(0, angle.max(), 256)[:, None]
    if (1 + to_there ** (powers - 1) @ (powers * lens.distortion)).min() <= 0:
        _reached(lens, np.array([np.inf]), where)
    direction = distorted / np.maximum(radius, 1e-12)[:, None]
    flat = angle < np.radians(89)
    with np.errstate(divide="ignore", invalid="ignore"):
        endless = np.where(np.abs(direction) > 1e-9, np.sign(direction) * np.inf, 0.0)
    return np.where(flat[:, None], direction * np.tan(np.where(flat, angle, 0.0))[:, None], endless)


def _rising(lens: LensCamera, rays: Float, where: str) -> None:
    """Refuses a radial factor that turns back between the axis and the border: there, two rays share a pixel."""
    k1, k2, _, _, k3, k4, k5, k6 = lens.distortion
    r = np.linspace(0, np.linalg.norm(rays, axis=-1).max(), 1024)
    s = r * r
    radial = r * (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))
    if np.diff(radial).min() <= 0:
        _reached(lens, np.array([np.inf]), where)


def _reached(lens: LensCamera, missed: Float, where: str) -> None:
    if not (missed <= TOLERANCE_PIXELS).all():
        listed = ", ".join(f"{value:g}" for value in lens.distortion)
        raise CaptureError(
            f"camera {lens.name!r}: its distortion ({lens.model} {listed}) cannot be undone at {where}: the polynomial "
            "turns back before it; calibrate with points out to the corners, or with another model"
        )
