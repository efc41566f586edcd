"""Search for points on which several cameras agree.

The search combines features, stereo, the visual hull and fitted surfaces.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from scas4d_core.captures.frame import InitialPoints
from scas4d_core.first_frame.points.merging import SPACING, average_per_cell, labelled_share, merge_candidates
from scas4d_core.first_frame.points.stereo import (
    MIN_NEIGHBOURS,
    DepthMap,
    count_violations,
    depth_maps,
    fused_points,
    plan_stereo,
)
from scas4d_core.first_frame.points.surfaces import (
    TOLERANCE,
    Support,
    fit_surfaces,
    sample_surfaces,
    snap_to_points,
    surface_depth,
)
from scas4d_core.first_frame.points.triangulation import FeatureTracks, Triangulation, triangulate
from scas4d_core.first_frame.points.visual_hull import MISSES, VisualHull, carve, count_contradictions, pixel_size_at
from scas4d_core.first_frame.time_limit import TimeLimit
from scas4d_core.posed_pictures import (
    Bool,
    Float,
    PosedPicture,
    halved,
    look_at_point,
    pixels_inside,
)

OnProgress = Callable[[str, int, int], None]
"""Callback that receives the name of a stage, and its completed and total numbers of steps."""

REFUTING_VIOLATIONS = 2
"""Number of cameras that must see through an unconfirmed point to reject the point. A single depth
may be wrong."""
REFUTING_MASKS = 1
"""Number of masks that must contradict a point to reject the point. One mask suffices, because all
masks support the hull."""


@dataclass(frozen=True, eq=False)
class PointSearch:
    """Inputs and settings of a point search.

    Attributes:
        labelled: views with the given masks, if any.
        views: the same views. If there is a backdrop, their masks are the silhouettes in front of
            the backdrop.
        tracks: feature tracks.
        backdrop: whether the masks of ``views`` are silhouettes in front of a backdrop.
        min_views: number of cameras that must agree on a point.
        stereo: whether to use dense stereo.
        iterations: number of stereo iterations.
        max_points: maximum number of points.
        radius: radius of the rig, in world units.
        seed: random seed.
        limit: time limit of frame 0.
    """

    labelled: Sequence[PosedPicture]
    views: Sequence[PosedPicture]
    tracks: FeatureTracks
    backdrop: bool
    min_views: int
    stereo: bool
    iterations: int
    max_points: int
    radius: float
    seed: int
    limit: TimeLimit


def find_agreeing_points(search: PointSearch, on_progress: OnProgress) -> InitialPoints:
    """Finds points on which at least ``search.min_views`` cameras agree.

    Raises:
        InitialPointsError: if there are no such points.
    """
    views, plain, min_views, seed = search.views, search.backdrop, search.min_views, search.seed
    middle = look_at_point(views)
    pixel = pixel_size_at(views, middle)

    triangulated = triangulate(views, search.tracks, min_views=min_views, seed=seed)
    on_progress("hull", 0, 1)
    hull = carve(views, misses=0.0 if plain else MISSES, min_views=min_views)
    supports: list[Support] = []
    # Two cameras can agree by chance anywhere along an epipolar line, so surfaces that are fitted
    # to such points are unreliable.
    if not plain and min_views > 2 and len(triangulated.positions) >= 10:
        static_points = triangulated.positions[~_in_foreground(views, triangulated)]
        supports = fit_surfaces(
            static_points,
            np.array([view.camera.centre for view in views]),
            TOLERANCE * search.radius,
            seed=seed,
        )

    maps: list[DepthMap] = []
    if search.stereo:
        maps = _stereo(search, triangulated, hull, supports, middle, on_progress)
    on_progress("merging", 0, 1)
    confirmed = np.concatenate([fused_points(maps, min_views), triangulated.positions])
    if not plain and len(hull.cells):
        confirmed = confirmed[count_contradictions(views, hull, confirmed, MISSES) < REFUTING_MASKS]

    solid = _free_hull(hull, maps, min_views)
    walls = np.zeros((0, 3))
    if supports:
        # About one sample per four pixels of the stereo images is dense enough for the thinning below.
        stride = max(2, max(view.camera.width for view in views) // 160)
        samples = sample_surfaces(views, supports, stride, search.radius)
        samples, _ = average_per_cell(samples, 2.0 * SPACING * pixel)
        samples = snap_to_points(samples, supports, confirmed, 4.0 * TOLERANCE * search.radius)
        walls = samples[count_violations(maps, samples, min_views) < REFUTING_VIOLATIONS]
    sources = (confirmed, solid, walls)
    return merge_candidates(search.labelled, views, sources, pixel, plain, bool(maps), search.max_points)


def _in_foreground(views: Sequence[PosedPicture], triangulated: Triangulation) -> Bool:
    """Returns whether each triangulated point is on the foreground, [P].

    A foreground point is inside the masks of most cameras that observed the point.
    """
    share = labelled_share(views, triangulated.positions, triangulated.views.T)
    return np.zeros(len(triangulated.positions), dtype=bool) if share is None else share > 0.5


def _stereo(
    search: PointSearch,
    triangulated: Triangulation,
    hull: VisualHull,
    supports: Sequence[Support],
    middle: Float,
    on_progress: OnProgress,
) -> list[DepthMap]:
    """Returns the depth maps of all downscaled images, or no maps if there is no time for stereo.

    Hull, surfaces and triangulated points limit the depth range and provide depths to try first.
    """
    views, plain = search.views, search.backdrop
    effort = plan_stereo(views, middle, search.iterations, search.limit)
    if effort is None:
        return []
    small = [halved(view, effort.width) for view in views]
    hull_surface = hull.centres[hull.surface()]
    known = hull_surface if plain else np.concatenate([triangulated.positions, hull_surface])
    ranges, priors, active = [], [], []
    for view in small:
        camera = view.camera
        shape = (camera.height, camera.width)
        prior = np.zeros(shape)
        depth = camera.to_camera(known)[:, 2] if len(known) else np.zeros(0)
        depth = depth[depth > 0]
        if supports:
            rows, columns = np.indices(shape)
            first = surface_depth(view, supports, np.stack([columns + 0.5, rows + 0.5], -1).reshape(-1, 2))[1]
            prior = np.where(np.isfinite(first), first, 0.0).reshape(shape)
            depth = np.concatenate([depth, prior[prior > 0][::16]])
        if len(depth) < 10:
            depth = np.array([0.05, 2.0]) * float(np.linalg.norm(camera.centre - middle))
        # The hull extends to the limits of the scene, but features do not, so their range is
        # widened more.
        low, high = (0.9, 1.1) if plain else (0.6, 1.3)
        ranges.append((low * float(np.percentile(depth, 1)), high * float(np.percentile(depth, 99))))
        if len(hull_surface):
            column, line, there, inside = pixels_inside(camera, hull_surface)
            nearest = np.full(shape, np.inf)
            np.minimum.at(nearest, (line[inside], column[inside]), there[inside])
            prior = np.where(np.isfinite(nearest), nearest, prior)
        priors.append(prior)
        active.append(view.mask if plain and view.mask is not None else np.ones(shape, dtype=bool))
    return depth_maps(
        small,
        ranges,
        priors,
        active,
        middle,
        iterations=effort.iterations,
        seed=search.seed,
        hull=hull,
        fewest=min(MIN_NEIGHBOURS, search.min_views - 1),
        progress=lambda done, total: on_progress("stereo", done, total),
    )


def _free_hull(hull: VisualHull, maps: Sequence[DepthMap], min_views: int) -> Float:
    """Returns the surface points [P, 3] of the hull without the voxels that cameras see through."""
    if len(hull.cells) == 0:
        return np.zeros((0, 3))
    solid = count_violations(maps, hull.centres, min_views, margin=0.01) < REFUTING_VIOLATIONS
    rest = replace(hull, cells=hull.cells[solid])
    return rest.centres[rest.surface()]
