"""Surface depth along single rays, for pixel queries that need more accuracy than rendered depth provides.

Rendered depth is the weighted mean of the *centres* of a pixel's Gaussians. Here, each Gaussian absorbs light along the
ray itself, around the point on the ray with the smallest Mahalanobis distance to its centre. The surface is at the
depth where half of the light lost along the ray has been absorbed. At an edge, the mean depth lies between two
surfaces, whereas this median lies on one of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from scas4d_core.cameras import Camera
from scas4d_core.engines.limits import DEFAULT, Limits
from scas4d_core.gaussians import Gaussians

Float = NDArray[np.float64]

TILE_PX = 16
"""Side length, in pixels, of the square tiles in which rays share one search for Gaussians."""
RAYS_AT_ONCE = 64
"""Number of rays processed at once, to limit working memory to a few megabytes."""
DEEPEST = 96
"""Maximum number of Gaussians per ray: those that absorb the most light. All others have no visible effect."""
RAY_SOFTENING = 0.003
"""Usual ``softening`` of a surface, as a fraction of the extent."""
BISECTIONS = 26
"""Number of bisection steps, which reduce a bracket of 10 m to less than a micrometre."""
REACH = 3.0
"""Maximum depth difference between a Gaussian's absorption and its centre, in standard deviations. If a ray only grazes
the rim of a flat Gaussian, the nearest point on the ray can be arbitrarily far away."""


def ray_depths(
    gaussians: Gaussians,
    camera: Camera,
    uv: NDArray[Any],
    limits: Limits = DEFAULT,
    softening: float = 0.0,
) -> tuple[Float, Float]:
    """Returns the depth and coverage of the surface at continuous pixel positions.

    Args:
        gaussians: state of N Gaussians in the internal world.
        camera: camera in the internal world.
        uv: [Q, 2] pixel positions; (0.5, 0.5) is the centre of the first pixel.
        limits: rasterizer constants. They ensure that a ray hits the same Gaussians as in the rendered pixel.
        softening: uncertainty of the surface in metres, added in quadrature to every axis of each Gaussian.

    Returns:
        The depth z [Q] along the camera's axis in metres, and the coverage [Q], which is the fraction of light in [0,
        1] that is absorbed along the ray. The depth is NaN if the ray hits nothing.

    >>> camera = Camera("front", [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4), 64, 48)
    >>> state = Gaussians.of_points([[0, 0, 2]], radius=0.1)
    >>> depth, covered = ray_depths(state, camera, np.array([[32, 24], [0.5, 0.5]]))
    >>> depth.round(3), covered.round(3)
    (array([1.936,   nan]), array([0.9, 0. ]))
    """
    uv = np.asarray(uv, dtype=np.float64)
    depth, covered = np.full(len(uv), np.nan), np.zeros(len(uv))
    splats = RaySplats(gaussians, camera, uv, limits, softening)
    order, cuts = tile_groups(uv)
    if not len(order) or not len(splats.z):
        return depth, covered
    for group in np.split(order, cuts):
        low, high = uv[group].min(axis=0), uv[group].max(axis=0)
        near = np.flatnonzero(
            ((splats.centre + splats.half >= low) & (splats.centre - splats.half <= high)).all(axis=1)
        )
        if len(near):
            for start in range(0, len(group), RAYS_AT_ONCE):
                rays = group[start : start + RAYS_AT_ONCE]
                depth[rays], covered[rays] = splats.depths(near, uv[rays])
    return depth, covered


def tile_groups(uv: Float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Groups pixel positions [Q, 2] by tile.

    Returns:
        The order [Q] in which the groups follow each other, and the start of every group but the first.
    """
    tiles = np.floor(uv / TILE_PX).astype(np.int64)
    order = np.lexsort((tiles[:, 0], tiles[:, 1]))
    return order, np.flatnonzero(np.any(np.diff(tiles[order], axis=0) != 0, axis=1)) + 1


class RaySplats:
    """The Gaussians around the rays in the image, sorted by depth and prepared for ray queries.

    Args:
        gaussians, camera, uv, limits, softening: see ``ray_depths``.

    Attributes:
        limits: rasterizer constants.
        lens: focal lengths [2] and principal point [2], in pixels.
        peak: [N] opacities.
        means, z: [N, 3] means in the camera's axes and [N] their depths, in metres.
        centre, half: [N, 2] projected means, and half sizes of the bounding boxes, in pixels.
        conic: [N, 2, 2] inverses of the projected covariances.
        precision: [N, 3, 3] inverses of the softened covariances in the camera's axes.
        spread: [N] standard deviations along z, in metres.
    """

    def __init__(self, gaussians: Gaussians, camera: Camera, uv: Float, limits: Limits, softening: float) -> None:
        turn, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
        means = gaussians.means.astype(np.float64) @ turn.T + shift
        peak = gaussians.opacities.astype(np.float64)
        rows = np.flatnonzero((means[:, 2] > limits.near) & (peak >= limits.alpha_floor))
        means, z, peak = means[rows], means[rows, 2:], peak[rows]
        focal, principal = self.lens = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
        factors = turn @ gaussians.factors[rows].astype(np.float64)
        margin = limits.tangent_margin * np.array([camera.width, camera.height]) / (2 * focal)
        tangents = np.clip(
            means[:, :2] / z,
            -principal / focal - margin,
            (np.array([camera.width, camera.height]) - principal) / focal + margin,
        )
        # The projected covariance of the rasterizer, including its low-pass filter.
        rows_of = focal[:, None] / z[:, :, None] * (factors[:, :2] - tangents[:, :, None] * factors[:, 2:3])
        flat = rows_of @ rows_of.transpose(0, 2, 1) + limits.low_pass * np.eye(2)
        centre = focal * means[:, :2] / z + principal
        reach = 2 * np.log(peak / limits.alpha_floor)
        half = np.sqrt(np.maximum(reach[:, None] * np.einsum("nii->ni", flat), 0))

        low, high = (uv.min(axis=0), uv.max(axis=0)) if len(uv) else (np.inf, -np.inf)
        rows = np.flatnonzero(((centre + half >= low) & (centre - half <= high)).all(axis=1))
        rows = rows[np.argsort(z[rows, 0], kind="stable")]
        self.limits, self.peak, self.means, self.z = limits, peak[rows], means[rows], z[rows, 0]
        self.centre, self.half, self.conic = centre[rows], half[rows], np.linalg.inv(flat[rows])
        softened = factors[rows] @ factors[rows].transpose(0, 2, 1) + (softening**2 + 1e-12) * np.eye(3)
        self.precision = np.linalg.inv(softened)
        self.spread = np.sqrt(softened[:, 2, 2])

    def depths(self, near: NDArray[np.intp], uv: Float) -> tuple[Float, Float]:
        """Returns the depth [Q] and coverage [Q] of rays; see ``ray_depths``.

        Args:
            near: indices of the candidate Gaussians, in front-to-back order.
            uv: [Q, 2] pixel positions of the rays.
        """
        limits = self.limits
        off = uv[:, None] - self.centre[near]
        power = 0.5 * np.einsum("qni,nij,qnj->qn", off, self.conic[near], off, optimize=True)
        alpha = np.minimum(limits.alpha_cap, self.peak[near] * np.exp(-power))
        alpha[alpha < limits.alpha_floor] = 0
        after = np.cumprod(1 - alpha, axis=1)
        before = np.concatenate([np.ones((len(uv), 1)), after[:, :-1]], axis=1)
        alpha[after <= limits.transmittance_stop] = 0  # the rasterizer stops before it blends this Gaussian
        covered = 1 - np.prod(1 - alpha, axis=1)

        # Each Gaussian absorbs around the point on the ray that is nearest to its centre in its own metric.
        most = min(DEEPEST, alpha.shape[1])
        chosen = np.argpartition(-alpha * before, most - 1, axis=1)[:, :most]
        absorbs = -np.log1p(-np.take_along_axis(alpha, chosen, axis=1))
        rows = near[chosen]
        focal, principal = self.lens
        ray = np.concatenate([(uv - principal) / focal, np.ones((len(uv), 1))], axis=1)
        leaning = np.einsum("qkij,qj->qki", self.precision[rows], ray)
        sharp = np.einsum("qki,qi->qk", leaning, ray)
        place = np.einsum("qki,qki->qk", leaning, self.means[rows]) / sharp
        centre, spread = self.z[rows], REACH * self.spread[rows]
        place = np.clip(place, centre - spread, centre + spread)
        width = 1 / np.sqrt(sharp)

        total = absorbs.sum(axis=1)
        half = -np.log1p(-0.5 * -np.expm1(-total))
        idle = absorbs <= 0
        low = np.where(idle, np.inf, place - 4 * width).min(axis=1)
        high = np.where(idle, -np.inf, place + 4 * width).max(axis=1)
        met = total > 0
        low, high = np.where(met, low, 0), np.where(met, high, 1)
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            lost = (absorbs * ndtr((middle[:, None] - place) / width)).sum(axis=1)
            low, high = np.where(lost < half, middle, low), np.where(lost < half, high, middle)
        return np.where(met, high, np.nan), covered
