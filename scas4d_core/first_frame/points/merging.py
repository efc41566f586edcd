"""Merging of candidate initial points from several sources into one point cloud."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scas4d_core.captures.frame import InitialPoints
from scas4d_core.posed_pictures import (
    Bool,
    Float,
    InitialPointsError,
    PosedPicture,
    observe,
    pixels_inside,
    visible_from,
)

SPACING = 1.5
"""Spacing of neighbouring points, in pixels at the scene centre. The spacing is doubled on the
background."""
COLOUR_SPREAD = 0.12
"""Maximum median deviation between the cameras' colours ([0, 1]) of a point. The limit does not apply
to points that stereo or features confirm."""
CROWD = 4
"""Minimum number of candidates within 1.5 cells of a stereo point, or in its cell. Many pixels see
a true surface, but few see the same outlier."""


def merge_candidates(
    labelled: Sequence[PosedPicture],
    views: Sequence[PosedPicture],
    sources: tuple[Float, Float, Float],
    pixel: float,
    plain: bool,
    stereo: bool,
    max_points: int,
) -> InitialPoints:
    """Thins, colours and labels candidate points, and drops candidates that the images contradict.

    Args:
        labelled: views with the given masks, if any.
        views: the same views. If the background is plain, their masks are the silhouettes in front
            of the background.
        sources: points on which cameras agree, hull points, and points on fitted surfaces. A point
            is used only if no earlier source has a point nearby.
        pixel: size of a pixel at the scene centre, in world units.
        plain: whether the masks of ``views`` are silhouettes.
        stereo: whether the first source contains stereo points.
        max_points: maximum number of points.

    Raises:
        InitialPointsError: if there are no candidates, or the images contradict all candidates.
    """
    fine = SPACING * pixel
    # Minimum number of cameras that must see a point of each source. If the number is 0, the
    # cameras need not agree on the colour of the point, because stereo or features confirm the
    # point. Hull points need two cameras. Points on walls need only one, because points nearby
    # support the wall.
    needed_by = (0, 2, 1)
    points, needed = np.zeros((0, 3)), np.zeros(0, dtype=np.intp)
    for source, (candidates, views_needed) in enumerate(zip(sources, needed_by, strict=True)):
        new, sizes = average_per_cell(candidates, fine)
        if source == 0 and stereo and len(new):
            # This filter also drops isolated features, but these are few, and the hull or walls
            # cover their surfaces.
            crowd = np.asarray(cKDTree(candidates).query_ball_point(new, 1.5 * fine, return_length=True))
            new = new[(crowd >= CROWD) | (sizes >= CROWD)]
        elif len(points) and len(new):
            new = new[np.asarray(cKDTree(points).query(new)[0]) > 2.5 * fine]
        points = np.concatenate([points, new])
        needed = np.concatenate([needed, np.full(len(new), views_needed, dtype=np.intp)])
    if len(points) == 0:
        raise InitialPointsError(
            "images: no point is confirmed by enough cameras; provide a point cloud, or check that the calibration "
            "belongs to the images"
        )
    visible = visible_from(views, points, fine)
    foreground = labelled_share(labelled, points, visible)
    if plain:
        # If a point projects onto the plain background in some view, it is next to an outline. The
        # view then does not show the colour of the point.
        for row, view in zip(visible, views, strict=True):
            column, line, _, _ = pixels_inside(view.camera, points)
            row &= np.asarray(view.mask)[line, column]
    elif foreground is not None:
        # Pixels of a person in front of a wall do not show the colour of the wall, and vice versa.
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
                chosen[members[pick_one_per_cell(points[members], spacing)]] = True
        if chosen.sum() <= max_points:
            break
        scale *= 1.15
    if not chosen.any():
        raise InitialPointsError(
            "images: the cameras do not agree on the colour of any point; provide a point cloud, or check that the "
            "calibration belongs to the images"
        )
    return InitialPoints(points[chosen], seen.colours[chosen], None if foreground is None else foreground[chosen])


def labelled_share(views: Sequence[PosedPicture], points: Float, visible: Bool) -> NDArray[np.float32] | None:
    """Returns the fraction of the cameras that see each point whose masks contain the point.

    Args:
        views: V views. Views without a mask are ignored.
        points: [P, 3] points in the world.
        visible: [V, P] bool, whether each point is visible in each view.

    Returns:
        [P] fractions, or None if no view has a mask.
    """
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


def pick_one_per_cell(points: Float, cell: float) -> NDArray[np.intp]:
    """Returns the index of one point in each occupied cubic cell with edge length ``cell``.

    The chosen point is the one nearest to the mean of the cell, so that the points are evenly
    distributed.
    """
    where, count = _cells(points, cell)
    means = np.stack([np.bincount(where, points[:, axis]) for axis in range(3)], axis=-1) / count[:, None]
    order = np.lexsort((((points - means[where]) ** 2).sum(-1), where))
    result: NDArray[np.intp] = order[np.concatenate([[0], np.cumsum(count)[:-1]])]
    return result


def average_per_cell(points: Float, cell: float) -> tuple[Float, NDArray[np.intp]]:
    """Returns the mean [Q, 3] and number [Q] of the points in each occupied cubic cell with edge length ``cell``."""
    if len(points) == 0:
        return points.reshape(-1, 3), np.zeros(0, dtype=np.intp)
    where, count = _cells(points, cell)
    means = np.stack([np.bincount(where, points[:, axis]) for axis in range(3)], axis=-1) / count[:, None]
    return means, count


def _cells(points: Float, cell: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Returns the cell index [P] of each point, and the number of points in each occupied cell.

    Occupied cells are numbered in the order of their x, y and z coordinates.
    """
    cells = np.floor(points / cell).astype(np.int64)
    cells -= cells.min(axis=0)
    size = cells.max(axis=0) + 1
    if float(size[0]) * float(size[1]) * float(size[2]) < 2**62:  # sorting one number is ten times faster than three
        cells = (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
    _, where, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    return where.ravel(), count
