"""Search for a plane on which images agree.

The plane is usually a floor or table, seen from directions that differ too much for stereo.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, binary_opening, gaussian_filter, minimum_filter, uniform_filter

from scas4d_core.captures.frame import InitialPoints
from scas4d_core.first_frame.points.merging import SPACING, labelled_share
from scas4d_core.first_frame.points.visual_hull import pixel_size_at
from scas4d_core.posed_pictures import (
    Bool,
    Float,
    InitialPointsError,
    PosedPicture,
    look_at_point,
    observe,
    pixels_inside,
)

Planes = NDArray[np.float32]

CELLS = 48
"""Number of cells along the side of the search square. At the scene centre, the square is as wide
as a typical image."""
MAX_CELLS = 160
"""Maximum number of cells along the side of the square when points are sampled."""
REACH = 1.5
"""Maximum offset of a plane from the scene centre, relative to half the side of the square."""
OFFSETS = 37
"""Number of offsets tried along a normal, two cells apart."""
TILT, TILTS = 0.2, 5
"""Maximum tilt about either axis of the square, in radians, and number of tilts per axis."""
ROUNDS = 6
"""Number of refinement rounds. After a round without improvement, step sizes are divided by
``SHRINK``."""
SHRINK = 1.7
UNLIKE = 0.8
"""Maximum cosine between the normals of two start planes. A start plane that is more similar to a
previous start plane is skipped."""
PATCH = 7
"""Side of the compared patches, in cells."""
TEXTURE = 4.0
"""Minimum standard deviation, in grey levels, of a textured patch."""
ALIKE, HALF_ALIKE = 0.6, 0.3
"""Correlation of patches above which two cameras agree on a cell, and correlation above which the
cell adds to the score of the plane."""
PAIRS = 2
"""Number of camera pairs that must agree on a cell. Two pairs involve at least three cameras."""
BEYOND_CHANCE = 1.8
"""Minimum score of a plane as a multiple of the score of mirrored images, which agree only by
chance. The ratio is 2.2 to 4.7 on six rigs with a floor or table, and 0.9 to 1.6 on three rigs with
neither."""
MIN_CELLS = 40
"""Minimum number of cells of a plane on which cameras agree."""
MAX_VIEWS = 6
"""Maximum number of compared views, which are evenly spaced in rig order."""
CLOSED = 15
"""Maximum width, in cells, of gaps between agreeing cells that are filled."""

NO_PLANE = "images: the cameras do not agree on any plane; provide a point cloud"


@dataclass(frozen=True, eq=False)
class Plane:
    """Square piece of a plane.

    Attributes:
        middle: [3] centre in the world.
        normal: [3] unit normal.
        half: half of the side length, in world units.
    """

    middle: Float
    normal: Float
    half: float

    def cells(self, count: int) -> Float:
        """Divides the square into count × count cells and returns their centres [count, count, 3] in the world.

        >>> Plane(np.zeros(3), np.array([0.0, 0.0, 1.0]), 2.0).cells(2).shape
        (2, 2, 3)
        """
        first, second = _axes(self.normal)
        steps = self.half * ((np.arange(count) + 0.5) / count * 2 - 1)
        across, along = np.meshgrid(steps, steps)
        return self.middle + across[..., None] * first + along[..., None] * second


def plane_points(labelled: Sequence[PosedPicture]) -> InitialPoints:
    """Returns points on the plane on which the images agree most.

    A plane has only two angles and an offset, so planes can be tried exhaustively (plane sweeping,
    Collins 1996). On the correct plane, even projected images from very different directions look
    the same. Patches are compared by correlation, so exposures may differ. Small gaps between
    agreeing cells are filled.

    Args:
        labelled: views, with masks if available.

    Raises:
        InitialPointsError: if there is no plane on which the images agree.

    >>> from scas4d_core.cameras import Camera
    >>> texture = np.random.default_rng(0).integers(0, 255, (100, 100, 1), np.uint8).repeat(3, axis=2)
    >>> def looking_down(x):  # from a height of two metres, towards the origin of a floor with tiles of six centimetres
    ...     back = np.array([x, 0, 2]) / np.hypot(x, 2)
    ...     rotation = np.array([np.cross([0, 1, 0], -back), [0, 1, 0], -back])
    ...     pose = np.eye(4)
    ...     pose[:3, :3], pose[:3, 3] = rotation, -rotation @ [x, 0, 2]
    ...     camera = Camera(str(x), np.array([[100.0, 0, 60], [0, 100, 60], [0, 0, 1]]), pose, 120, 120)
    ...     uv = np.stack(np.meshgrid(np.arange(120) + 0.5, np.arange(120) + 0.5), axis=-1).reshape(-1, 2)
    ...     ray = camera.unproject(uv, np.ones(len(uv))) - camera.centre
    ...     tile = (camera.centre - ray * 2 / ray[:, 2:])[:, :2] / 0.06 % 100
    ...     return PosedPicture(camera, texture[tuple(tile.astype(int).T)].reshape(120, 120, 3))
    >>> found = plane_points([looking_down(x) for x in (-2.0, 0.1, 2.0)])
    >>> len(found) > 500, bool(np.abs(found.positions[:, 2]).max() < 0.05)
    (True, True)
    """
    views = [labelled[i] for i in np.unique(np.linspace(0, len(labelled) - 1, MAX_VIEWS).astype(int))]
    plane = agreed_plane(views)
    count = min(MAX_CELLS, max(CELLS, int(2 * plane.half / (SPACING * pixel_size_at(views, plane.middle)))))
    points = plane.cells(count)
    closed = binary_closing(np.pad(_agreed_cells(views, plane, count), CLOSED), np.ones((CLOSED, CLOSED), bool))
    within = binary_opening(closed, np.ones((5, 5), bool))
    flat = points[within[CLOSED:-CLOSED, CLOSED:-CLOSED]]
    inside = np.array([pixels_inside(view.camera, flat)[3] for view in labelled])
    shared = inside.sum(axis=0) >= 2
    flat, inside = flat[shared], inside[:, shared]
    if not len(flat):
        raise InitialPointsError(NO_PLANE)
    return InitialPoints(flat, observe(labelled, flat, inside).colours, labelled_share(labelled, flat, inside))


def agreed_plane(views: Sequence[PosedPicture]) -> Plane:
    """Returns the plane on which images agree most.

    Planes near three start planes are compared: a horizontal plane, a plane parallel to the ring of
    cameras, and a plane that faces the cameras.

    Raises:
        InitialPointsError: if the images agree on too few cells, or hardly more than mirrored
            images do.
    """
    candidates = [(_best(views, start), start) for start in _starts(views)]
    (score, plane), start = max(candidates, key=lambda one: one[0][0])
    mirrored = [replace(view, image=np.ascontiguousarray(view.image[:, ::-1])) for view in views]
    cells = _agreed_cells(views, plane, CELLS)
    if cells.sum() < MIN_CELLS or score < BEYOND_CHANCE * _best(mirrored, start, refine=False)[0]:
        raise InitialPointsError(NO_PLANE)
    return plane


def _agreed_cells(views: Sequence[PosedPicture], plane: Plane, count: int) -> Bool:
    """Returns whether enough pairs of cameras agree on each cell, [count, count]."""
    pairs = _agreement(views, _smooth(views, plane, count), plane.cells(count)[None])[1][0]
    agreed: Bool = pairs >= min(PAIRS, len(views) - 1)
    return agreed


def _starts(views: Sequence[PosedPicture]) -> list[Plane]:
    """Returns start planes through the scene centre whose normals differ sufficiently.

    The candidates are the three start planes of ``agreed_plane``.
    """
    middle = look_at_point(views)
    centres = np.array([view.camera.centre for view in views])
    up = -np.mean([view.camera.rotation[1] for view in views], axis=0)
    ring = np.linalg.svd(centres - centres.mean(axis=0))[2][2]
    facing = np.mean([view.camera.rotation[2] for view in views], axis=0)
    reach = [max(view.camera.width, view.camera.height) / (2 * view.camera.fx) for view in views]
    half = float(np.median(reach * np.linalg.norm(centres - middle, axis=1)))
    chosen: list[Plane] = []
    for normal in (up, ring, facing):
        length = float(np.linalg.norm(normal))
        if length < 0.3:  # the cameras have no common up or viewing direction
            continue
        if all(abs(normal @ other.normal) < UNLIKE * length for other in chosen):
            chosen.append(Plane(middle, normal / length, half))
    return chosen


def _best(views: Sequence[PosedPicture], start: Plane, refine: bool = True) -> tuple[float, Plane]:
    """Returns the score of the best plane near a start plane, and that plane."""
    smooth = _smooth(views, start, CELLS)

    def scores_of(moves: Float) -> Float:
        return _agreement(views, smooth, np.stack([_moved(start, move).cells(CELLS) for move in moves]))[0]

    tilts = np.linspace(-TILT, TILT, TILTS)
    tried = np.stack(np.meshgrid(tilts, tilts), axis=-1).reshape(-1, 2)
    best, at = -1.0, np.zeros(3)
    for offset in np.linspace(-REACH, REACH, OFFSETS):
        moves = np.column_stack([np.full(len(tried), offset), tried])
        scores = scores_of(moves)
        if scores.max() > best:
            best, at = float(scores.max()), moves[int(scores.argmax())]
    steps = np.array([REACH / OFFSETS, TILT / TILTS, TILT / TILTS])
    for _ in range(ROUNDS if refine else 0):
        moves = at + np.concatenate([np.diag(steps), -np.diag(steps)])
        scores = scores_of(moves)
        if scores.max() > best:
            best, at = float(scores.max()), moves[int(scores.argmax())]
        else:
            steps = steps / SHRINK
    return best, _moved(start, at)


def _moved(start: Plane, move: Float) -> Plane:
    """Returns ``start`` offset by ``move[0]`` half squares along its normal and tilted by ``move[1:]``."""
    first, second = _axes(start.normal)
    normal = start.normal + move[1] * first + move[2] * second
    return Plane(start.middle + move[0] * start.half * start.normal, normal / np.linalg.norm(normal), start.half)


def _axes(normal: Float) -> tuple[Float, Float]:
    """Returns two unit vectors that are orthogonal to the normal and to each other."""
    first = np.cross(normal, np.eye(3)[int(np.abs(normal).argmin())])
    first /= np.linalg.norm(first)
    return first, np.cross(normal, first)


def _smooth(views: Sequence[PosedPicture], plane: Plane, count: int) -> list[Planes]:
    """Returns the images in greyscale, low-pass filtered to the size of a cell of the plane."""
    cell = 2 * plane.half / count / pixel_size_at(views, plane.middle)
    return [gaussian_filter(view.image.mean(axis=2, dtype=np.float32), max(0.5, cell / 2)) for view in views]


def _agreement(
    views: Sequence[PosedPicture], smooth: Sequence[Planes], points: Float
) -> tuple[Float, NDArray[np.intp]]:
    """Measures how well images agree on each of several planes.

    Args:
        views: views of the cameras.
        smooth: filtered greyscale image of each view.
        points: [T, C, C, 3] cell centres of each plane, in the world.

    Returns:
        [T] score of each plane, and [T, C, C] number of camera pairs that agree on each cell. The
        score is the correlation in excess of ``HALF_ALIKE``, summed over cells and camera pairs.
    """
    laid = [_warp_to_plane(view, picture, points) for view, picture in zip(views, smooth, strict=True)]
    scores, pairs = np.zeros(len(points)), np.zeros(points.shape[:3], np.intp)
    for i, (one, mean, spread, textured) in enumerate(laid):
        for other, other_mean, other_spread, other_textured in laid[:i]:
            both = textured & other_textured
            if not both.any():
                continue
            covariance = _box(one * other) - mean * other_mean
            alike = np.where(both, covariance / np.maximum(spread * other_spread, 1), 0)
            pairs += alike > ALIKE
            scores += np.maximum(alike - HALF_ALIKE, 0).sum(axis=(1, 2))
    return scores, pairs


def _warp_to_plane(view: PosedPicture, picture: Planes, points: Float) -> tuple[Planes, Planes, Planes, Bool]:
    """Warps an image to planes, and measures the patches around the cells.

    Returns:
        Four arrays [T, C, C]: the warped image, the mean and standard deviation of the patch around
        each cell, and whether the patch is textured and completely inside the image.
    """
    uv, depth = view.camera.project(points.reshape(-1, 3))
    height, width = picture.shape
    with np.errstate(invalid="ignore"):
        column, line = uv[:, 0] - 0.5, uv[:, 1] - 0.5
        inside = (depth > 0) & (column >= 0) & (column < width - 1) & (line >= 0) & (line < height - 1)
    column, line = np.where(inside, column, 0), np.where(inside, line, 0)
    left, top = column.astype(np.intp), line.astype(np.intp)
    right, down = (column - left).astype(np.float32), (line - top).astype(np.float32)
    upper = picture[top, left] * (1 - right) + picture[top, left + 1] * right
    lower = picture[top + 1, left] * (1 - right) + picture[top + 1, left + 1] * right
    values = np.asarray(upper * (1 - down) + lower * down, np.float32).reshape(points.shape[:3])
    mean = _box(values)
    variance = _box(values * values) - mean * mean
    spread = np.sqrt(variance.clip(0))
    whole: Bool = minimum_filter(inside.reshape(points.shape[:3]), (1, PATCH, PATCH), mode="constant")
    return values, mean, spread, whole & (spread > TEXTURE)


def _box(values: Planes) -> Planes:
    """Returns the patch means of each plane."""
    means: Planes = uniform_filter(values, (1, PATCH, PATCH), mode="nearest")
    return means
