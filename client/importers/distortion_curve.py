"""`DistortionCurve`: how a lens bends rays, and back, as far as its polynomial rises. Numpy only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from client.importers.lens import LensCamera

Float = NDArray[np.float64]

FLAT = np.radians(89.0)
"""Angle from the axis beyond which no plane before the camera is met."""
SAMPLES = 8192
STEEP = 0.1
"""Of the slope on the axis. A polynomial that turns back has no points of its calibration near its top, and there a
tenth of a pixel of the lens would fill a pixel: it is not believed where it is flatter."""
NEWTON = 8
ROUNDS = 60
"""Of the tangential part, which is small: rounds shrink its error by its size."""
CLOSE = 1e-7
"""At distance 1: a ray that bends back to its pixel this well is found."""


@dataclass(frozen=True, eq=False)
class DistortionCurve:
    """The bending of a lens: by the ray's radius at distance 1 or, of a fisheye, by its angle from the axis.

    Attributes:
        lens: whose.
        reach: radius (angle) up to which it is believed.
        turns: true where the picture goes on beyond it: the polynomial turns back before the farthest corner.
        samples: [S] radii (angles) from 0 to `reach`.
        bends: [S] bent radii, rising.
    """

    lens: LensCamera
    reach: float
    turns: bool
    samples: Float
    bends: Float

    @classmethod
    def of(cls, lens: LensCamera) -> DistortionCurve:
        """Measures a lens that is not straight."""
        samples = np.linspace(0, np.pi, SAMPLES) if lens.fisheye else np.tan(np.linspace(0, FLAT, SAMPLES))
        bends, slopes = _profile(lens, samples)
        corners = np.array([[0, 0], [lens.width, 0], [0, lens.height], [lens.width, lens.height]])
        distorted = (corners - lens.intrinsics[:2, 2]) / lens.intrinsics.diagonal()[:2]
        # The tangential part may bend a corner's ray farther than its pixel is.
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
        """Radius of a ray at distance 1 up to which the lens is believed; infinite beyond 89°."""
        if not self.lens.fisheye:
            return self.reach
        return float(np.tan(self.reach)) if self.reach < FLAT else np.inf

    def distort(self, rays: Float) -> Float:
        """Rays (x/z, y/z) [P, 2], within `widest`, to where the lens's plane at distance 1 shows them [P, 2]."""
        radius = np.linalg.norm(rays, axis=-1, keepdims=True)
        of = np.arctan(radius) if self.lens.fisheye else radius
        bends, _ = _profile(self.lens, of)
        return rays * np.where(radius > 0, bends / np.maximum(radius, 1e-12), 1.0) + _tangential_offset(self.lens, rays)

    def undistort(self, bent: Float) -> Float:
        """Undoes `bent`, [P, 2] to [P, 2]: ±infinity beyond 89° of a fisheye, NaN where no ray is believed."""
        if self.lens.fisheye or not _tangential(self.lens).any():
            return self._undistort_radial(bent)
        rays = self._undistort_radial(bent)
        for _ in range(ROUNDS):
            rays = self._undistort_radial(bent - _tangential_offset(self.lens, rays))
        close = np.abs(self.distort(rays) - bent).max(axis=-1) < CLOSE
        return np.where(close[:, None], rays, np.nan)

    def _undistort_radial(self, bent: Float) -> Float:
        """Undoes the radial part alone."""
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
    """Bent radii of radii (angles of a fisheye), and the slopes there; both of the shape given."""
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
    """p1 and p2 of OpenCV, [2]."""
    return np.zeros(2) if lens.fisheye else lens.distortion[2:4]


def _tangential_offset(lens: LensCamera, rays: Float) -> Float:
    """The tangential part of the bending, [P, 2]."""
    p1, p2 = _tangential(lens)
    x, y = rays[:, 0], rays[:, 1]
    r2 = x * x + y * y
    return np.stack([2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], axis=-1)
