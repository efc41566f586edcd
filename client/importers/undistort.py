"""Undistorts images of perspective and fisheye lenses to pinhole images with the same pose and size, using OpenCV.

The pinhole camera keeps the pixel aspect ratio of the lens and covers only rays that the lens saw, so there are no
black corners. These rays determine the principal point. If the distortion polynomial decreases before a corner, the
field of view is narrowed to the rays for which the polynomial increases.

OpenCV puts the centre of the first pixel at (0, 0), whereas this project and COLMAP put it at (0.5, 0.5). Principal
points passed to OpenCV are therefore reduced by half a pixel. Otherwise, images would be shifted by half a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from client.importers.distortion_curve import DistortionCurve
from client.importers.extras import opencv
from client.importers.lens import LensCamera
from scas4d_core.cameras import Camera
from scas4d_core.captures import CaptureError

Float = NDArray[np.float64]
Picture = NDArray[np.uint8]

WIDEST_DEGREES = 120.0
"""Maximum field of view of a pinhole camera in degrees. A wider view would stretch a fisheye image too much."""
BORDER_POINTS = 64
TOLERANCE_PIXELS = 0.01
"""Maximum distance, in pixels, by which the pinhole's border may lie outside the image. Interpolation hides the gap."""
NARROWING = 1.005
"""Factor by which the focal length grows per step while a lens with non-monotonic distortion is cropped."""
MOST_NARROWED = 50.0
"""Maximum focal length in the search for a pinhole camera, as a multiple of the lens's focal length."""
LEAST_KEPT = 0.25
"""Minimum fraction of the image that must remain after cropping. A smaller fraction indicates a wrong calibration."""
HALF = 0.5


@dataclass(frozen=True, eq=False)
class Undistorter:
    """Undistorter for the images of one camera. Images without distortion are returned unchanged, without using OpenCV.

    Args:
        lens: calibrated camera with lens distortion.

    Raises:
        CaptureError: if less than a quarter of the image can be undistorted.
        MissingExtraError: if OpenCV is needed but not installed.
    """

    lens: LensCamera

    @cached_property
    def camera(self) -> Camera:
        """Pinhole camera of the undistorted images."""
        return self.lens.pinhole() if self.lens.is_pinhole else self.lens.pinhole(self._view.intrinsics)

    @cached_property
    def remark(self) -> str | None:
        """Message about a lens that is cropped because its distortion is not monotonic, or None for other lenses."""
        if self.lens.is_pinhole or self._view.kept is None:
            return None
        return (
            f"camera {self.lens.name!r}: its distortion is not monotonic near the corners, where calibration had no "
            f"points; {1 - self._view.kept:.0%} of its image is cropped"
        )

    @cached_property
    def _view(self) -> _View:
        return _inscribed(self.lens)

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
        if self.lens.is_pinhole:
            return np.ones((self.lens.height, self.lens.width), dtype=bool)
        u, v = self._maps  # in OpenCV's coordinates, image edges are at −0.5 and size − 0.5
        inside = (u >= -HALF) & (u <= self.lens.width - HALF) & (v >= -HALF) & (v <= self.lens.height - HALF)
        return np.asarray(inside)

    def picture(self, picture: Picture) -> Picture:
        """Undistorts an image [H, W, 3] of the lens, and returns an image [H, W, 3] of the pinhole camera.

        Lanczos interpolation is used, which keeps dots within 0.03 pixels of their true positions. Cubic interpolation
        shifts them by up to 0.08 pixels, and linear interpolation blurs the image.
        """
        return self._remapped(picture, "INTER_LANCZOS4")

    def mask(self, mask: Picture) -> Picture:
        """Undistorts a mask or label image [H, W] with nearest-neighbour interpolation."""
        return self._remapped(mask, "INTER_NEAREST")

    def _remapped(self, picture: Picture, how: str) -> Picture:
        if picture.shape[:2] != (self.lens.height, self.lens.width):
            raise CaptureError(
                f"camera {self.lens.name!r}: its image is {picture.shape[1]}x{picture.shape[0]}, but it was calibrated "
                f"for {self.lens.width}x{self.lens.height}"
            )
        if self.lens.is_pinhole:
            return picture
        cv2 = opencv()
        result: Picture = cv2.remap(picture, *self._maps, getattr(cv2, how), borderMode=cv2.BORDER_REPLICATE)
        return result


def _shifted(intrinsics: Float) -> Float:
    """Returns the intrinsics for OpenCV's pixel coordinates, in which pixel centres are at integers."""
    shifted = intrinsics.copy()
    shifted[:2, 2] -= HALF
    return shifted


@dataclass(frozen=True, eq=False)
class _View:
    """The pinhole camera that replaces a lens.

    Attributes:
        intrinsics: [3, 3] in pixels.
        kept: fraction of the lens's image that the pinhole camera covers; None unless the lens is cropped.
    """

    intrinsics: Float
    kept: float | None = None


def _inscribed(lens: LensCamera) -> _View:
    """Returns a pinhole camera that keeps the pixel aspect ratio of the lens and covers only rays that the lens saw."""
    curve = DistortionCurve.of(lens)
    left, top, right, bottom = _inner_rectangle(lens, curve)
    fx, fy = lens.intrinsics[0, 0], lens.intrinsics[1, 1]
    # One factor for both focal lengths preserves the pixel aspect ratio.
    factor = max(lens.width / ((right - left) * fx), lens.height / ((bottom - top) * fy))
    k = np.diag([factor * fx, factor * fy, 1.0])
    k[0, 2] = lens.width / 2 - k[0, 0] * (left + right) / 2
    k[1, 2] = lens.height / 2 - k[1, 1] * (top + bottom) / 2
    return _within(lens, curve, k) if curve.turns else _View(k)


def _within(lens: LensCamera, curve: DistortionCurve, k: Float) -> _View:
    """Narrows a pinhole camera about the lens's axis until the distortion polynomial increases across its entire image.

    Raises:
        CaptureError: if too little of the image remains.
    """
    border, size = np.concatenate(list(_edges(lens).values())), np.array([lens.width, lens.height])
    kept = 0.0
    while k[0, 0] < MOST_NARROWED * lens.intrinsics[0, 0]:
        rays = (border - k[:2, 2]) / k.diagonal()[:2]
        at = curve.distort(rays) * lens.intrinsics.diagonal()[:2] + lens.intrinsics[:2, 2]
        inside = (at > -TOLERANCE_PIXELS) & (at < size + TOLERANCE_PIXELS)
        if inside.all() and np.linalg.norm(rays, axis=-1).max() <= curve.max_radius:
            x, y = at.T
            kept = float(abs(x @ np.roll(y, 1) - y @ np.roll(x, 1))) / 2 / (lens.width * lens.height)
            break
        k[0, 0], k[1, 1] = NARROWING * k[0, 0], NARROWING * k[1, 1]
    if kept < LEAST_KEPT:
        raise CaptureError(
            f"camera {lens.name!r}: its distortion ({_listed(lens)}) folds over within the image, and only {kept:.0%} "
            "of the image could be undistorted; calibrate with points up to the corners, or with another model"
        )
    return _View(k, kept)


def _edges(lens: LensCamera) -> dict[str, Float]:
    """Returns pixels [P, 2] along each edge of the lens's image, keyed by edge, in order around the image."""
    x, y = (np.linspace(0, length, BORDER_POINTS) for length in (lens.width, lens.height))
    return {
        "top": np.stack([x, np.zeros_like(x)], axis=-1),
        "right": np.stack([np.full_like(y, lens.width), y], axis=-1),
        "bottom": np.stack([x[::-1], np.full_like(x, lens.height)], axis=-1),
        "left": np.stack([np.zeros_like(y), y[::-1]], axis=-1),
    }


def _inner_rectangle(lens: LensCamera, curve: DistortionCurve) -> tuple[float, float, float, float]:
    """Returns (left, top, right, bottom), at distance 1, of a rectangle inside the region that the lens saw.

    Each side lies at the innermost point of the corresponding undistorted image edge. If the distortion is not
    monotonic, `_within` crops the corners afterwards.

    Raises:
        CaptureError: if the rectangle is empty.
    """
    limit = min(np.tan(np.radians(WIDEST_DEGREES / 2)), curve.max_radius)
    rays = {side: undistort_pixels(lens, pixels, curve) for side, pixels in _edges(lens).items()}
    seen = {side: points[~np.isnan(points).any(axis=-1)] for side, points in rays.items()}
    left, top = (seen[side][:, axis].max(initial=-limit) for axis, side in enumerate(("left", "top")))
    right, bottom = (seen[side][:, axis].min(initial=limit) for axis, side in enumerate(("right", "bottom")))
    if not (left < right and top < bottom):
        raise CaptureError(
            f"camera {lens.name!r}: nothing is left of its image after undistortion (from {left:.3g}, {top:.3g} to "
            f"{right:.3g}, {bottom:.3g} at distance 1); check its principal point and coefficients"
        )
    return float(left), float(top), float(right), float(bottom)


def undistort_pixels(lens: LensCamera, pixels: Float, curve: DistortionCurve | None = None) -> Float:
    """Maps pixels [P, 2] of the lens to rays (x/z, y/z) [P, 2].

    For a fisheye, rays beyond 89° from the axis are ±infinity. Rays are NaN if the distortion polynomial decreases
    before it reaches the pixel.
    """
    curve = curve or DistortionCurve.of(lens)
    return curve.undistort((pixels - lens.intrinsics[:2, 2]) / lens.intrinsics.diagonal()[:2])


def _listed(lens: LensCamera) -> str:
    return " ".join([lens.model, *(f"{value:g}" for value in lens.distortion)])
