"""Large smooth surfaces, such as walls, floors and domes, fitted to triangulated points.

Smooth walls have few features, and stereo produces floaters near such walls. A plane or sphere
through many triangulated points fills in the wall between the points. The fit uses RANSAC (Fischler
& Bolles 1981), followed by least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from scas4d_core.posed_pictures import Bool, Float, PosedPicture

MAX_SURFACES = 3
"""Maximum number of planes and spheres. Scenes rarely have more walls, floors and domes."""
TOLERANCE = 0.012
"""Maximum distance of an inlier from a fitted surface, in rig radii."""
TRIALS = 1500
MIN_SHARE = 0.1
"""Minimum fraction of the triangulated points that a surface must explain."""
MIN_INLIERS = 30
CAMERA_SLACK = 1.25
"""Maximum distance of a camera from the centre of a dome, in dome radii. Cameras are often mounted
on the dome itself."""
MAX_BEHIND = 0.15
"""Maximum fraction of the triangulated points behind a surface. Almost no point is behind the wall
of a room."""
MAX_RADIUS = 2.0
"""Maximum radius of a dome, in rig radii. A larger sphere resembles a wall, for which a plane needs
fewer parameters."""
GAP_PLANE = 0.5
GAP_SPHERE = 1.5
"""Maximum distance, in rig radii, from a surface sample to the nearest triangulated point on the surface."""


class Surface(Protocol):
    """Surface that bounds a room and is seen from inside the room."""

    def offsets(self, points: Float) -> Float:
        """Returns the [P] signed distances of points [P, 3] along ``normals``."""

    def normals(self, points: Float) -> Float:
        """Returns the [P, 3] unit normals at the surface points nearest to points [P, 3]."""

    def hit(self, origin: Float, directions: Float) -> Float:
        """Returns the ray parameters [R] at which rays from inside the room meet the surface.

        Args:
            origin: [3] start of all rays.
            directions: [R, 3] directions of the rays.

        Returns:
            [R] ray parameters, or infinity for rays that do not meet the surface.
        """


@dataclass(frozen=True, eq=False)
class PatchPlane:
    """Plane with the equation normal · x = offset, where |normal| = 1."""

    normal: Float
    offset: float

    def offsets(self, points: Float) -> Float:
        """Returns the [P] signed distances."""
        result: Float = points @ self.normal - self.offset
        return result

    def normals(self, points: Float) -> Float:
        """Returns the plane's normal for each point, [P, 3]."""
        return np.broadcast_to(self.normal, points.shape)

    def hit(self, origin: Float, directions: Float) -> Float:
        """Returns the ray parameters [R] of the intersections, or infinity if a ray points away."""
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (self.offset - origin @ self.normal) / (directions @ self.normal)
        result: Float = np.where(along > 0, along, np.inf)
        return result


@dataclass(frozen=True, eq=False)
class Sphere:
    """Dome around the cameras. Rays meet the far side of the sphere."""

    centre: Float
    radius: float

    def offsets(self, points: Float) -> Float:
        """Returns the [P] signed distances, positive outside."""
        result: Float = np.linalg.norm(points - self.centre, axis=-1) - self.radius
        return result

    def normals(self, points: Float) -> Float:
        """Returns the [P, 3] outward normals."""
        outward = points - self.centre
        result: Float = outward / np.maximum(np.linalg.norm(outward, axis=-1, keepdims=True), 1e-12)
        return result

    def hit(self, origin: Float, directions: Float) -> Float:
        """Returns the ray parameters [R] of the far intersections, or infinity if a ray misses."""
        offset = origin - self.centre
        a = (directions**2).sum(-1)
        b = directions @ offset
        c = offset @ offset - self.radius**2
        inside = b**2 - a * c
        far = (-b + np.sqrt(np.maximum(inside, 0.0))) / a
        result: Float = np.where((inside >= 0) & (far > 0), far, np.inf)
        return result


@dataclass(frozen=True, eq=False)
class Support:
    """Fitted surface, and the inlier points [S, 3] that support the surface."""

    surface: Surface
    points: Float


def fit_plane(points: Float) -> PatchPlane | None:
    """Returns the least-squares plane of points [P, 3], P ≥ 3, or None if they are collinear."""
    middle = points.mean(0)
    _, values, axes = np.linalg.svd(points - middle, full_matrices=False)
    if len(points) < 3 or values[1] < 1e-9 * max(values[0], 1e-300):
        return None
    normal = axes[2]
    return PatchPlane(normal, float(normal @ middle))


def fit_sphere(points: Float) -> Sphere | None:
    """Returns the least-squares sphere of points [P, 3], P ≥ 4, or None if they are coplanar.

    Solves |x|² = 2 x·c + (r² − |c|²), which is linear in c and r² − |c|².
    """
    middle = points.mean(0)
    local = points - middle
    matrix = np.hstack([2.0 * local, np.ones((len(points), 1))])
    answer, _, rank, _ = np.linalg.lstsq(matrix, (local**2).sum(-1), rcond=1e-9)
    square = answer[3] + answer[:3] @ answer[:3]
    if rank < 4 or square <= 0:
        return None
    return Sphere(answer[:3] + middle, float(np.sqrt(square)))


def fit_surfaces(
    points: Float, centres: Float, tolerance: float, *, most: int = MAX_SURFACES, seed: int = 0
) -> list[Support]:
    """Returns planes and spheres that bound the room that contains the cameras, best supported first.

    Args:
        points: [P, 3] triangulated points, without the foreground if it is known.
        centres: [V, 3] camera centres, which must be on the same side of a plane, or within ``CAMERA_SLACK`` radii of
            the centre of a sphere.
        tolerance: maximum distance of an inlier from a surface, in world units.
        most: maximum number of surfaces.
        seed: random seed of RANSAC.
    """
    rng = np.random.default_rng(seed)
    rest = points
    supports: list[Support] = []
    needed = max(MIN_INLIERS, int(MIN_SHARE * len(points)))
    while len(supports) < most and len(rest) >= needed:
        best: Surface | None = None
        most_inliers = 0
        for trial in range(TRIALS):
            kind = trial % 2
            sample = rest[rng.choice(len(rest), 3 + kind, replace=False)]
            candidate = fit_sphere(sample) if kind else fit_plane(sample)
            if candidate is None or not _bounds(candidate, points, centres, tolerance):
                continue
            inliers = int((np.abs(candidate.offsets(rest)) <= tolerance).sum())
            if inliers > most_inliers:
                best, most_inliers = candidate, inliers
        if best is None:
            break
        for _ in range(5):
            near = rest[np.abs(best.offsets(rest)) <= tolerance]
            again = _refined(best, near, tolerance)
            if again is None or not _bounds(again, points, centres, tolerance):
                break
            best = again
        on = np.abs(best.offsets(rest)) <= tolerance
        if on.sum() < needed:
            break
        supports.append(Support(best, rest[on]))
        # Points close to this surface must not support a second, nearly identical surface.
        rest = rest[np.abs(best.offsets(rest)) > 2.0 * tolerance]
    return supports


def _bounds(surface: Surface, points: Float, centres: Float, tolerance: float) -> bool:
    """Returns whether the surface bounds a room that contains the cameras and nearly all points."""
    cameras, behind = surface.offsets(centres), surface.offsets(points)
    if isinstance(surface, Sphere):
        reach = np.linalg.norm(centres - surface.centre, axis=1).max()
        radius = np.linalg.norm(centres - centres.mean(0), axis=1).max()
        if reach > CAMERA_SLACK * surface.radius or surface.radius > MAX_RADIUS * radius:
            return False
    else:
        if not ((cameras > -tolerance).all() or (cameras < tolerance).all()):
            return False
        if cameras.mean() > 0:
            behind = -behind
    return bool((behind > 3.0 * tolerance).mean() <= MAX_BEHIND)


def _sphere_residuals(parameters: Float, near: Float) -> Float:
    result: Float = np.linalg.norm(near - parameters[:3], axis=1) - parameters[3]
    return result


def _refined(surface: Surface, near: Float, tolerance: float) -> Surface | None:
    if isinstance(surface, PatchPlane):
        return fit_plane(near) if len(near) >= 3 else None
    assert isinstance(surface, Sphere)
    if len(near) < 4:
        return None
    answer = least_squares(
        _sphere_residuals,
        np.array([*surface.centre, surface.radius]),
        args=(near,),
        loss="soft_l1",
        f_scale=tolerance / 2,
    )
    return Sphere(np.asarray(answer.x[:3]), float(answer.x[3]))


def surface_depth(view: PosedPicture, supports: Sequence[Support], uv: Float) -> tuple[Float, Float]:
    """Intersects the rays through pixels [R, 2] with the surfaces.

    Returns:
        The first intersection [R, 3] of each ray, and its depth along z [R]. If there is no
        intersection, the values are NaN and infinity.
    """
    camera = view.camera
    ones = np.ones(len(uv))
    directions = camera.unproject(uv, ones) - camera.centre
    depth = np.full(len(uv), np.inf)
    for support in supports:
        depth = np.minimum(depth, support.surface.hit(camera.centre, directions))
    met = np.isfinite(depth)
    points = np.full((len(uv), 3), np.nan)
    points[met] = camera.centre + directions[met] * depth[met, None]
    return points, depth


def sample_surfaces(views: Sequence[PosedPicture], supports: Sequence[Support], stride: int, scale: float) -> Float:
    """Returns surface points [P, 3] that the cameras see, for every ``stride``-th row and column.

    Pixels inside the masks are ignored. A sample far from every triangulated point of its surface
    (see ``GAP_…``) is skipped, unless the sample is inside a fitted dome.

    Args:
        views: views of the cameras. Pixels inside the mask show other objects.
        supports: fitted surfaces.
        stride: spacing of the sampled pixels.
        scale: radius of the rig, in world units.
    """
    if not supports:
        return np.zeros((0, 3))
    domes = [s.surface for s in supports if isinstance(s.surface, Sphere)]
    samples = []
    for view in views:
        across, down = (np.arange(stride / 2, size, stride) for size in (view.camera.width, view.camera.height))
        uv = np.stack(np.meshgrid(across, down, indexing="xy"), axis=-1).reshape(-1, 2)
        if view.mask is not None:
            uv = uv[~view.mask[uv[:, 1].astype(int), uv[:, 0].astype(int)]]
        points, depth = surface_depth(view, supports, uv)
        points = points[np.isfinite(depth)]
        if len(points) == 0:
            continue
        distance = np.stack([np.abs(s.surface.offsets(points)) for s in supports])
        nearest = distance.argmin(0)
        keep = np.zeros(len(points), dtype=bool)
        for index, support in enumerate(supports):
            mine = nearest == index
            if not mine.any():
                continue
            gap = GAP_SPHERE if isinstance(support.surface, Sphere) else GAP_PLANE
            near: Bool = np.asarray(cKDTree(support.points).query(points[mine])[0]) <= gap * scale
            within = np.zeros(len(near), dtype=bool)
            for dome in domes:
                within |= np.linalg.norm(points[mine] - dome.centre, axis=1) < 0.999 * dome.radius
            keep[mine] = near | within
        samples.append(points[keep])
    return np.concatenate(samples) if samples else np.zeros((0, 3))


def snap_to_points(points: Float, supports: Sequence[Support], seen: Float, reach: float) -> Float:
    """Moves surface samples along the surface normal towards the measured points around them.

    Domes consist of panels, and floors are not quite flat. Each sample is therefore moved by the
    mean offset of the measured points around the sample. The fitted surface itself counts as one
    more measurement with offset 0.

    Args:
        points: [P, 3] samples on the surfaces.
        supports: fitted surfaces.
        seen: [M, 3] measured points.
        reach: distance in world units. Measured points farther away from the sample have little
            weight, and measured points farther away from the surface have none.
    """
    if len(points) == 0 or len(seen) == 0:
        return points
    moved = points.copy()
    distance = np.stack([np.abs(s.surface.offsets(points)) for s in supports])
    nearest = distance.argmin(0)
    for index, support in enumerate(supports):
        mine = np.flatnonzero(nearest == index)
        offsets = support.surface.offsets(seen)
        close = np.abs(offsets) <= reach
        if not close.any() or len(mine) == 0:
            continue
        count = min(16, int(close.sum()))
        gap, who = cKDTree(seen[close]).query(points[mine], k=count)
        gap, who = np.reshape(gap, (len(mine), count)), np.reshape(who, (len(mine), count))
        weight = np.exp(-0.5 * (gap / reach) ** 2)
        shift = (weight * offsets[close][who]).sum(1) / (weight.sum(1) + 1.0)
        moved[mine] += support.surface.normals(points[mine]) * shift[:, None]
    return moved
