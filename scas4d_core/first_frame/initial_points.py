"""Initial points: a cloud from the pictures of frame 0 and calibrated cameras alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scas4d_core.cameras import Rig
from scas4d_core.captures.frame import InitialPoints
from scas4d_core.first_frame.posed_pictures import (
    Bool,
    Float,
    InitialPointsError,
    PosedPicture,
    collect_views,
    look_at_point,
    observe,
    pixels_inside,
    visible_from,
)
from scas4d_core.first_frame.silhouettes import plain_background, with_silhouettes
from scas4d_core.first_frame.stereo import ITERATIONS, DepthMap, depth_maps, fused_points, halved, looked_through
from scas4d_core.first_frame.surfaces import TOLERANCE, Support, fit_surfaces, sample_surfaces, settle, surface_depth
from scas4d_core.first_frame.triangulation import Triangulation, triangulate
from scas4d_core.first_frame.visual_hull import MISSES, VisualHull, carve, contradicted, pixel_at

OnProgress = Callable[[str, int, int], None]
"""Called with a stage, the steps done and the steps in all."""

MAX_POINTS = 60_000
"""Points kept at most; where there are more, the spacing grows."""
MIN_VIEWS = 3
"""Cameras that must agree on a point: two always meet somewhere on an epipolar line."""
SPACING = 1.5
"""Distance of neighbouring points, pixels at the middle of the stage; twice that on the background."""

COLOUR_SPREAD = 0.12
"""Median deviation of the cameras' colours (0…1) above which a point that stereo has not confirmed is in the wrong
place."""
LOOKED_THROUGH = 2
"""Cameras looking through an unconfirmed point that refute it: one depth may be wrong."""
CONTRADICTED = 1
"""Masks speaking against a point that refute it: one is enough, for all masks agree on the hull behind the point."""
CROWD = 4
"""Stereo points that the 27 cells about one must hold: true surfaces are seen by many pixels, strays by few."""


def initial_points(
    rig: Rig,
    images: Mapping[str, NDArray[np.uint8]],
    masks: Mapping[str, NDArray[np.uint8]],
    progress: OnProgress | None = None,
    *,
    max_points: int = MAX_POINTS,
    stereo: bool = True,
    stereo_iterations: int = ITERATIONS,
    seed: int = 0,
) -> InitialPoints:
    """Finds points on the surfaces that the pictures of one moment show.

    Triangulation features bound the scene and support walls and floors; PatchMatch stereo, kept where at least
    ``MIN_VIEWS`` cameras agree and few look through, gives what has texture; the visual hull (of the masks, or of
    silhouettes before a plain background) and the fitted surfaces give the rest. No point rests on one camera
    alone, except on a wall or floor that others have found.

    Args:
        rig: calibrated cameras, in the user's world.
        images: [H, W, 3] uint8 by camera name; cameras without a picture are ignored.
        masks: [H, W] uint8 by camera name, 1 = foreground; may be empty.
        progress: called with (stage, done, total).
        max_points: points kept at most.
        stereo: dense stereo where the pictures have texture.
        stereo_iterations: rounds of propagation and refinement.
        seed: of every random choice; the same seed gives the same points.

    Returns:
        Points in the user's units; ``foreground`` is None where no masks were given.

    Raises:
        InitialPointsError: fewer than two pictures, a picture whose size is not its camera's, or nothing found.

    >>> from scas4d_core.captures import open_capture
    >>> capture = open_capture("samples/robot", image_scale=0.5)
    >>> frame = capture.frame(0)
    >>> cloud = initial_points(capture.rig, frame.images, frame.masks, stereo=False)
    >>> cloud.positions.shape == cloud.colours.shape, bool((cloud.foreground <= 1).all())
    (True, True)
    """
    on_progress: OnProgress = progress or (lambda stage, done, total: None)
    labelled = collect_views(rig, images, masks)
    min_views = min(MIN_VIEWS, len(labelled))
    middle = look_at_point(labelled)
    pixel = pixel_at(labelled, middle)

    background = plain_background(labelled)
    plain = background is not None
    views = with_silhouettes(labelled, background) if background is not None else labelled

    on_progress("triangulation", 0, 1)
    triangulated = triangulate(views, min_views=min_views, seed=seed)
    on_progress("hull", 0, 1)
    hull = carve(views, misses=0.0 if plain else MISSES, min_views=min_views)
    supports: list[Support] = []
    if not plain and len(triangulated.positions) >= 10:
        standing = triangulated.positions[~_in_foreground(views, triangulated)]
        supports = fit_surfaces(
            standing,
            np.array([view.camera.centre for view in views]),
            TOLERANCE * rig.radius,
            seed=seed,
        )

    maps: list[DepthMap] = []
    if stereo:
        maps = _stereo(views, triangulated, hull, supports, plain, middle, stereo_iterations, seed, on_progress)
    on_progress("merging", 0, 1)
    confirmed = np.concatenate([fused_points(maps, min_views), triangulated.positions])
    if not plain and len(hull.cells):
        confirmed = confirmed[contradicted(views, hull, confirmed, MISSES) < CONTRADICTED]

    solid = _free_hull(hull, maps, min_views)
    walls = np.zeros((0, 3))
    if supports:
        # One sample for about every four pixels of stereo's pictures is as dense as the thinning below needs.
        stride = max(2, max(view.camera.width for view in views) // 160)
        samples = sample_surfaces(views, supports, stride, rig.radius)
        samples, _ = thinned(samples, 2.0 * SPACING * pixel)
        samples = settle(samples, supports, confirmed, 4.0 * TOLERANCE * rig.radius)
        walls = samples[looked_through(maps, samples, min_views) < LOOKED_THROUGH]
    return _merged(labelled, views, (confirmed, solid, walls), pixel, plain, stereo, max_points)


def _in_foreground(views: Sequence[PosedPicture], triangulated: Triangulation) -> Bool:
    """[P] true where most of the cameras that saw a triangulated point have it in their mask."""
    points = triangulated.positions
    said, yes = np.zeros(len(points)), np.zeros(len(points))
    for view, seen in zip(views, triangulated.views.T, strict=True):
        if view.mask is None:
            continue
        column, line, _, inside = pixels_inside(view.camera, points)
        said += inside & seen
        yes += inside & seen & view.mask[line, column]
    result: Bool = yes > 0.5 * np.maximum(said, 1)
    return result


def _stereo(
    views: Sequence[PosedPicture],
    triangulated: Triangulation,
    hull: VisualHull,
    supports: Sequence[Support],
    plain: bool,
    middle: Float,
    iterations: int,
    seed: int,
    on_progress: OnProgress,
) -> list[DepthMap]:
    """Depth maps of all pictures, halved; the search starts from hull, surfaces and triangulated points."""
    small = [halved(view) for view in views]
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
        # Features do not reach the ends of the scene, a hull does.
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
        iterations=iterations,
        seed=seed,
        hull=hull,
        progress=lambda done, total: on_progress("stereo", done, total),
    )


def _free_hull(hull: VisualHull, maps: Sequence[DepthMap], min_views: int) -> Float:
    """[P, 3] surface of the hull without the space that cameras look through."""
    if len(hull.cells) == 0:
        return np.zeros((0, 3))
    solid = looked_through(maps, hull.centres, min_views, margin=0.01) < LOOKED_THROUGH
    rest = replace(hull, cells=hull.cells[solid])
    return rest.centres[rest.surface()]


def _merged(
    labelled: Sequence[PosedPicture],
    views: Sequence[PosedPicture],
    sources: tuple[Float, Float, Float],
    pixel: float,
    plain: bool,
    stereo: bool,
    max_points: int,
) -> InitialPoints:
    """Thins, colours and labels the candidates, and drops those that the pictures contradict.

    ``sources``: points that cameras agree on, points of the hull, points of fitted surfaces; a later source counts only
    where no earlier one has a point.
    """
    fine = SPACING * pixel
    # Cameras that must see a point and agree on its colour: none once more, where stereo or features agree already;
    # two for the hull, which all masks support; one for a wall that is known from elsewhere.
    needed_by = (0, 2, 1)
    points, needed = np.zeros((0, 3)), np.zeros(0, dtype=np.intp)
    for source, (candidates, views_needed) in enumerate(zip(sources, needed_by, strict=True)):
        new, sizes = thinned(candidates, fine)
        if source == 0 and stereo and len(new):
            # Features are few and checked; the hull and the walls cover those that lie near no point of stereo.
            crowd = np.asarray(cKDTree(candidates).query_ball_point(new, 1.5 * fine, return_length=True))
            new = new[(crowd >= CROWD) | (sizes >= CROWD)]
        elif len(points) and len(new):
            new = new[np.asarray(cKDTree(points).query(new)[0]) > 2.5 * fine]
        points = np.concatenate([points, new])
        needed = np.concatenate([needed, np.full(len(new), views_needed, dtype=np.intp)])
    if len(points) == 0:
        raise InitialPointsError(
            "images: no point is supported by enough cameras; check that the calibration belongs to the pictures, "
            "or start from a point cloud"
        )
    visible = visible_from(views, points, fine)
    foreground = _foreground(labelled, points, visible)
    if plain:
        # A point that projects to the plain background there lies beside an outline, and has none of its colour.
        for row, view in zip(visible, views, strict=True):
            column, line, _, _ = pixels_inside(view.camera, points)
            row &= np.asarray(view.mask)[line, column]
    elif foreground is not None:
        # A person in front of a wall is no sample of the wall's colour, nor the wall of the person's.
        for row, view in zip(visible, views, strict=True):
            if view.mask is not None:
                column, line, _, _ = pixels_inside(view.camera, points)
                row &= view.mask[line, column] == (foreground > 0.5)
    seen = observe(views, points, visible)
    good = (seen.count >= np.maximum(needed, 1)) & ((needed == 0) | (seen.spread <= COLOUR_SPREAD))
    coarse = np.zeros(len(points), dtype=bool) if foreground is None else foreground < 0.5
    scale = 1.0
    while True:
        chosen = good.copy()
        for group, spacing in ((coarse, 2.0 * fine * scale), (~coarse, fine * scale)):
            members = np.flatnonzero(group & good)
            if len(members) and spacing > fine:
                chosen[members] = False
                chosen[members[_spaced(points[members], spacing)]] = True
        if chosen.sum() <= max_points:
            break
        scale *= 1.15
    if not chosen.any():
        raise InitialPointsError(
            "images: the cameras contradict every candidate point; check that the calibration belongs to the pictures, "
            "or start from a point cloud"
        )
    return InitialPoints(points[chosen], seen.colours[chosen], None if foreground is None else foreground[chosen])


def _foreground(views: Sequence[PosedPicture], points: Float, visible: Bool) -> NDArray[np.float32] | None:
    """[P] share of the cameras that may see each point whose mask holds it; None without masks."""
    said, yes = np.zeros(len(points)), np.zeros(len(points))
    for row, view in zip(visible, views, strict=True):
        if view.mask is None:
            continue
        column, line, _, inside = pixels_inside(view.camera, points)
        said += row & inside
        yes += row & inside & view.mask[line, column]
    if all(view.mask is None for view in views):
        return None
    return (yes / np.maximum(said, 1)).astype(np.float32)


def _spaced(points: Float, cell: float) -> NDArray[np.intp]:
    """Index of one point for each cubic cell, the nearest to the mean of the cell's points: that spreads evenly."""
    cells = np.floor(points / cell).astype(np.int64)
    _, where = np.unique(cells, axis=0, return_inverse=True)
    where = where.ravel()
    count = np.bincount(where)
    means = np.stack([np.bincount(where, points[:, axis]) for axis in range(3)], axis=-1) / count[:, None]
    order = np.lexsort((((points - means[where]) ** 2).sum(-1), where))
    result: NDArray[np.intp] = order[np.concatenate([[0], np.cumsum(count)[:-1]])]
    return result


def thinned(points: Float, cell: float) -> tuple[Float, NDArray[np.intp]]:
    """Means [Q, 3] of the points in each cubic cell of edge ``cell``, and the number of points in each [Q]."""
    if len(points) == 0:
        return points.reshape(-1, 3), np.zeros(0, dtype=np.intp)
    cells = np.floor(points / cell).astype(np.int64)
    _, where, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    where = where.ravel()
    means = np.stack([np.bincount(where, points[:, axis]) for axis in range(3)], axis=-1) / count[:, None]
    return means, count
