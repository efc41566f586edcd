"""Applies and inverts lens distortion where its polynomial is monotonic. Requires only numpy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from client.importers.lens import LensCamera

Float = NDArray[np.float64]

FLAT = np.radians(89.0)
"""Angle from the optical axis, in radians, beyond which a ray is considered parallel to the plane at distance 1."""
SAMPLES = 8192
STEEP = 0.1
"""Smallest trusted slope of the radial profile, relative to the slope on the axis.

No calibration points constrain a non-monotonic polynomial near its maximum. Where the slope is smaller than this value,
undistortion would stretch a tenth of a pixel of the lens's image over more than a pixel.
"""
NEWTON = 8
ROUNDS = 60
"""Number of fixed-point iterations for the tangential part. They converge quickly because this part is small."""
CLOSE = 1e-7
"""Maximum residual on the plane at distance 1 for a ray to be accepted as a solution."""


@dataclass(frozen=True, eq=False)
class DistortionCurve:
    """Radial distortion profile of a lens, as a function of a ray's radius at distance 1 or, for a fisheye, its angle.

    Attributes:
        lens: camera with lens distortion.
        reach: largest radius (fisheye: angle from the axis) at which the profile is trusted.
        turns: True if the image extends beyond `reach` because the polynomial decreases before the farthest corner.
        samples: [S] radii (fisheye: angles) from 0 to `reach`.
        bends: [S] distorted radii at `samples`, in increasing order.
    """

    lens: LensCamera
    reach: float
    turns: bool
    samples: Float
    bends: Float

    @classmethod
    def of(cls, lens: LensCamera) -> DistortionCurve:
        """Returns the sampled profile of a lens with distortion."""
        samples = np.linspace(0, np.pi, SAMPLES) if lens.fisheye else np.tan(np.linspace(0, FLAT, SAMPLES))
        bends, slopes = _profile(lens, samples)
        corners = np.array([[0, 0], [lens.width, 0], [0, lens.height], [lens.width, lens.height]])
        distorted = (corners - lens.intrinsics[:2, 2]) / lens.intrinsics.diagonal()[:2]
        # The tangential part may move a corner's ray outwards, beyond the corner's own radius.
        needed = np.linalg.norm(distorted, axis=-1).max() * (1 + 4 * np.abs(_tangential(lens)).sum())
        with np.errstate(invalid="ignore"):
            rises = (np.diff(bends, prepend=-1.0) > 0) & (slopes > 0)
        end = len(samples) if rises.all() else int(np.argmin(rises))
        enough = np.flatnonzero(bends[:end] >= needed)
        if len(enough):
            end, turns = int(enough[0]) + 1, False
        else:
            steep = np.flatnonzero(slopes[:end] < STEEP)
            end, turns = max(2, int(steep[0]) if len(steep) else end), True
        return cls(lens, float(samples[end - 1]), turns, samples[:end], bends[:end])

    @property
    def max_radius(self) -> float:
        """Largest trusted radius of a ray at distance 1; infinite for a fisheye that is trusted beyond 89°."""
        if not self.lens.fisheye:
            return self.reach
        return float(np.tan(self.reach)) if self.reach < FLAT else np.inf

    def distort(self, rays: Float) -> Float:
        """Maps rays (x/z, y/z) [P, 2] within `max_radius` to distorted points [P, 2] on the plane at distance 1."""
        radius = np.linalg.norm(rays, axis=-1, keepdims=True)
        of = np.arctan(radius) if self.lens.fisheye else radius
        bends, _ = _profile(self.lens, of)
        return rays * np.where(radius > 0, bends / np.maximum(radius, 1e-12), 1.0) + _tangential_offset(self.lens, rays)

    def undistort(self, bent: Float) -> Float:
        """Maps distorted points [P, 2] back to rays [P, 2], as the inverse of `distort`.

        The result is ±infinity beyond 89° for a fisheye, and NaN for points that no trusted ray reaches.
        """
        if self.lens.fisheye or not _tangential(self.lens).any():
            return self._undistort_radial(bent)
        rays = self._undistort_radial(bent)
        for _ in range(ROUNDS):
            rays = self._undistort_radial(bent - _tangential_offset(self.lens, rays))
        close = np.abs(self.distort(rays) - bent).max(axis=-1) < CLOSE
        return np.where(close[:, None], rays, np.nan)

    def _undistort_radial(self, bent: Float) -> Float:
        """Inverts only the radial part of the distortion."""
        radius = np.linalg.norm(bent, axis=-1)
        of = np.interp(radius, self.bends, self.samples)
        for _ in range(NEWTON):
            value, slope = _profile(self.lens, of)
            of = np.clip(of - (value - radius) / np.maximum(slope, 1e-6), 0, self.reach)
        direction = bent / np.maximum(radius, 1e-12)[:, None]
        flat = of < FLAT
        if self.lens.fisheye:
            with np.errstate(divide="ignore", invalid="ignore"):
                endless = np.where(np.abs(direction) > 1e-9, np.sign(direction) * np.inf, 0.0)
            rays = np.where(flat[:, None], direction * np.tan(np.where(flat, of, 0.0))[:, None], endless)
        else:
            rays = direction * of[:, None]
        return np.where((radius <= self.bends[-1] + CLOSE)[:, None], rays, np.nan)


def _profile(lens: LensCamera, of: Float) -> tuple[Float, Float]:
    """Returns distorted radii and slopes of the profile at the given radii (fisheye: angles)."""
    s = of * of
    if lens.fisheye:
        k1, k2, k3, k4 = lens.distortion
        bends = of * (1 + s * (k1 + s * (k2 + s * (k3 + s * k4))))
        return bends, 1 + s * (3 * k1 + s * (5 * k2 + s * (7 * k3 + s * 9 * k4)))
    k1, k2, _, _, k3, k4, k5, k6 = lens.distortion
    above, below = 1 + s * (k1 + s * (k2 + s * k3)), 1 + s * (k4 + s * (k5 + s * k6))
    d_above, d_below = k1 + s * (2 * k2 + s * 3 * k3), k4 + s * (2 * k5 + s * 3 * k6)
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = above / below
        return of * factor, factor + 2 * s * (d_above * below - above * d_below) / (below * below)


def _tangential(lens: LensCamera) -> Float:
    """Returns OpenCV's coefficients p1 and p2 as an array [2]."""
    return np.zeros(2) if lens.fisheye else lens.distortion[2:4]


def _tangential_offset(lens: LensCamera, rays: Float) -> Float:
    """Returns the offset [P, 2] of each ray due to tangential distortion."""
    p1, p2 = _tangential(lens)
    x, y = rays[:, 0], rays[:, 1]
    r2 = x * x + y * y
    return np.stack([2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], axis=-1)
