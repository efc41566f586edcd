"""Dense stereo: depth maps of several cameras, and the points on which the depth maps agree."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from scas4d_core.first_frame.points.patch_match import patch_match
from scas4d_core.first_frame.points.visual_hull import VisualHull
from scas4d_core.first_frame.time_limit import STEREO, TimeLimit
from scas4d_core.posed_pictures import Bool, Float, PosedPicture, halved, pixels_inside

WIDTH = 320
"""Maximum image width, in pixels. Wider images are halved repeatedly."""
PACE_WIDTH = 80
"""Maximum width of the image on which the pace is measured. The measurement takes a few percent of
the work for one image."""
PLANES_FIRST, PLANES_EACH = 3, 12
"""Number of planes tried per pixel, initially and in each round (``patch_match``)."""
NEIGHBOURS = 4
"""Number of other cameras with which each image is compared."""
MIN_NEIGHBOURS = 2
"""Minimum number of neighbours of an image. A match with only one neighbour is often wrong."""
ITERATIONS = 4
"""Number of rounds of propagation and refinement."""
MAX_COST = 0.35
"""Maximum cost 1 − NCC of an accepted match. Accepted depths are then compared between cameras."""
REPROJECTION = 1.0
"""Maximum reprojection error, in pixels, after projecting a point into another camera's depth map and back."""
DEPTH_AGREEMENT = 0.01
"""Maximum relative difference between two cameras' depths of the same point."""
MIN_ANGLE_DEG, MAX_ANGLE_DEG = 4.0, 50.0
"""Minimum and maximum angle between two cameras' rays to the scene centre. At smaller angles, depth
is uncertain. At larger angles, patches look different."""


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Stereo depths of one image.

    Attributes:
        view: camera and image, at the size used for stereo.
        depth: [H, W] depth along z, in world units, or 0 if the depth is unknown.
        agreeing: [H, W] number of other cameras whose depths agree.
    """

    view: PosedPicture
    depth: Float
    agreeing: NDArray[np.intp]

    def trusted(self, others: int) -> Float:
        """Returns the depth of pixels on which at least ``others`` other cameras agree, and 0 elsewhere."""
        result: Float = np.where(self.agreeing >= others, self.depth, 0.0)
        return result


@dataclass(frozen=True)
class StereoBudget:
    """Effort for stereo.

    Attributes:
        width: maximum image width in pixels.
        iterations: number of rounds of propagation and refinement.
    """

    width: int
    iterations: int


def plan_stereo(views: Sequence[PosedPicture], middle: Float, iterations: int, limit: TimeLimit) -> StereoBudget | None:
    """Returns the largest effort that the time limit allows, or None if no effort is affordable.

    The pace is measured on a tiny image.

    Args:
        views: views at full size.
        middle: [3] scene centre; see ``depth_maps``.
        iterations: requested number of rounds.
        limit: time limit of frame 0.
    """
    efforts = [
        StereoBudget(width, rounds) for width in (WIDTH, WIDTH // 2) for rounds in (iterations, -(-iterations // 2))
    ]
    if not limit.bounded:
        return efforts[0]
    tiny = [halved(view, PACE_WIDTH) for view in views]
    paced = next((i for i in range(len(tiny)) if len(neighbours_of(tiny, i, middle)) > 1), None)
    if paced is None:
        return efforts[0]
    began, camera = limit.clock(), tiny[paced].camera
    shape, far = (camera.height, camera.width), 2.0 * float(np.linalg.norm(camera.centre - middle))
    wanted = np.ones(shape, bool)
    _match(tiny, [_grey(view) for view in tiny], paced, middle, (far / 8, far), np.zeros(shape), wanted, 1, 2, 0)
    each = (limit.clock() - began) / (camera.width * camera.height * (PLANES_FIRST + PLANES_EACH))
    costs = [
        each * (PLANES_FIRST + PLANES_EACH * effort.iterations) * sum(_pixels(view, effort.width) for view in views)
        for effort in efforts
    ]
    index = limit.choose(STEREO, costs)
    if index == len(efforts):
        limit.shortened.append("no stereo")
        return None
    if index:
        planned_effort = efforts[index]
        limit.shortened.append(
            f"stereo on images at most {planned_effort.width} pixels wide, with {planned_effort.iterations} rounds"
        )
    return efforts[index]


def load_stereo() -> None:
    """Loads or compiles the kernel in advance.

    Loading and compilation would otherwise distort the measured pace.
    """
    grey, planes = np.zeros((16, 16), np.float32), np.zeros((1, 16, 16), np.float32)
    patch_match(
        grey, np.ones((16, 16), bool), np.zeros((16, 16)), np.ones(4), planes, np.full((1, 2), 16), np.eye(3)[None],
        np.ones((1, 3)), near=1.0, far=2.0, iterations=1, best=1, seed=0,
    )  # fmt: skip


def _pixels(view: PosedPicture, width: int) -> int:
    """Returns the number of pixels of a view after ``halved``."""
    columns, rows = view.camera.width, view.camera.height
    while columns > width:
        columns, rows = columns // 2, rows // 2
    return columns * rows


def neighbours_of(views: Sequence[PosedPicture], index: int, middle: Float) -> list[int]:
    """Returns the indices of the views to compare with a view.

    These are the views whose rays to the scene centre have the smallest angles to the ray of the
    view, within the angle limits.

    Args:
        views: all views.
        index: index of the view to compare.
        middle: [3] scene centre.
    """
    rays = np.array([view.camera.centre - middle for view in views])
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    angle = np.degrees(np.arccos(np.clip(rays @ rays[index], -1, 1)))
    fit = [i for i in np.argsort(angle, kind="stable") if i != index and MIN_ANGLE_DEG <= angle[i] <= MAX_ANGLE_DEG]
    return [int(i) for i in fit[:NEIGHBOURS]]


def depth_maps(
    views: Sequence[PosedPicture],
    ranges: Sequence[tuple[float, float]],
    priors: Sequence[Float],
    active: Sequence[Bool],
    middle: Float,
    *,
    iterations: int = ITERATIONS,
    seed: int = 0,
    hull: VisualHull | None = None,
    fewest: int = MIN_NEIGHBOURS,
    progress: Callable[[int, int], None] | None = None,
) -> list[DepthMap]:
    """Computes the depth map of every view with PatchMatch, and compares the depths between views.

    Args:
        views: views, whose sizes may differ; see ``halved``.
        ranges: (near, far) depth limits of each view, in world units.
        priors: [H, W] depths to try first in each view, 0 where there is none.
        active: [H, W] pixels to compute in each view.
        middle: [3] scene centre, about which angles between cameras are measured.
        iterations: number of rounds of PatchMatch.
        seed: random seed for sampling planes.
        hull: hull of the masks, or None. Depths of masked pixels that are not near the hull are
            rejected.
        fewest: minimum number of neighbours of an image.
        progress: function called with (completed views, number of views).
    """
    greys = [_grey(view) for view in views]
    depths = []
    for i, view in enumerate(views):
        depths.append(
            _match(views, greys, i, middle, ranges[i], priors[i], active[i], iterations, fewest, seed * 1009 + i)
        )
        if hull is not None and len(hull.cells) and view.mask is not None:
            _confine(view, depths[-1], hull)
        if progress is not None:
            progress(i + 1, len(views))
    return [DepthMap(view, depths[i], _agreement(views, depths, i)) for i, view in enumerate(views)]


def _grey(view: PosedPicture) -> NDArray[np.float32]:
    """Returns the luma of the image in [0, 1], [H, W]."""
    weights = np.array([0.299, 0.587, 0.114], np.float32)
    return np.ascontiguousarray(view.image.astype(np.float32) @ weights / np.float32(255))


def _match(
    views: Sequence[PosedPicture],
    greys: Sequence[NDArray[np.float32]],
    index: int,
    middle: Float,
    depths: tuple[float, float],
    prior: Float,
    active: Bool,
    iterations: int,
    fewest: int,
    seed: int,
) -> Float:
    """Returns the depth [H, W] of one view, or 0 for unreliable matches; see ``depth_maps``."""
    chosen = neighbours_of(views, index, middle)
    camera = views[index].camera
    if len(chosen) < fewest:
        return np.zeros(greys[index].shape)
    matrices, shifts = [], []
    for j in chosen:
        other = views[j].camera
        rotation = other.rotation @ camera.rotation.T
        matrices.append(other.intrinsics @ rotation)
        shifts.append(other.intrinsics @ (other.translation - rotation @ camera.translation))
    depth, _, cost = patch_match(
        greys[index],
        active,
        prior,
        np.array([1 / camera.fx, -camera.cx / camera.fx, 1 / camera.fy, -camera.cy / camera.fy]),
        *_pad_pictures([greys[j] for j in chosen]),
        np.stack(matrices),
        np.stack(shifts),
        near=depths[0],
        far=depths[1],
        iterations=iterations,
        best=min(MIN_NEIGHBOURS, len(chosen)),
        seed=seed,
    )
    return np.where(cost <= MAX_COST, depth, 0.0)


def _pad_pictures(pictures: Sequence[NDArray[np.float32]]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Pads images to the largest height and width.

    Returns:
        The images [V, H, W], each in the upper left corner of its plane, and their sizes [V, 2].
    """
    sizes = np.array([picture.shape for picture in pictures], np.int64)
    planes = np.zeros((len(pictures), *sizes.max(axis=0)), np.float32)
    for plane, picture in zip(planes, pictures, strict=True):
        plane[: picture.shape[0], : picture.shape[1]] = picture
    return planes, sizes


def _confine(view: PosedPicture, depth: Float, hull: VisualHull) -> None:
    """Sets depths of foreground pixels to 0, in place, if their points are not near the hull.

    The hull contains the entire foreground.
    """
    rows, columns = np.nonzero((depth > 0) & np.asarray(view.mask))
    if len(rows) == 0:
        return
    points = view.camera.unproject(np.stack([columns + 0.5, rows + 0.5], -1), depth[rows, columns])
    off = ~hull.is_near(points)
    depth[rows[off], columns[off]] = 0.0


def _agreement(views: Sequence[PosedPicture], depths: Sequence[Float], index: int) -> NDArray[np.intp]:
    """Returns the number of other cameras [H, W] whose depth maps agree with each pixel.

    The point of the pixel is projected into the depth map of the other camera. The two depths of
    the point must be similar, and the point of the other depth map must project back to the pixel.
    """
    camera, depth = views[index].camera, depths[index]
    rows, columns = np.nonzero(depth > 0)
    uv = np.stack([columns + 0.5, rows + 0.5], axis=-1)
    points = camera.unproject(uv, depth[rows, columns])
    count = np.zeros(depth.shape, dtype=np.intp)
    for j, view in enumerate(views):
        if j == index:
            continue
        column, line, there, inside = pixels_inside(view.camera, points)
        other_depth = depths[j][line, column]
        with np.errstate(divide="ignore", invalid="ignore"):
            good = inside & (other_depth > 0) & (np.abs(other_depth - there) <= DEPTH_AGREEMENT * there)
        seen, _ = view.camera.project(points[good])
        back = view.camera.unproject(seen, other_depth[good])
        again, _ = camera.project(back)
        close = np.linalg.norm(again - uv[good], axis=-1) <= REPROJECTION
        count[rows[good][close], columns[good][close]] += 1
    return count


def fused_points(maps: Sequence[DepthMap], min_views: int, max_violations: float = 0.5) -> Float:
    """Returns the points [P, 3] of all depth maps on which at least ``min_views`` cameras agree.

    A camera sees through a point if its trusted depth is clearly behind the point. A point is
    rejected as a floater if too many cameras see through the point. Their maximum number is
    ``max_violations`` times the number of cameras that agree on the point (after Merrell et al.
    2007).
    """
    fused = [np.zeros((0, 3))]
    for index, one in enumerate(maps):
        trusted = one.trusted(min_views - 1)
        rows, columns = np.nonzero(trusted > 0)
        points = one.view.camera.unproject(np.stack([columns + 0.5, rows + 0.5], -1), trusted[rows, columns])
        through = count_violations(maps, points, min_views, skip=index)
        fused.append(points[through <= max_violations * (1 + one.agreeing[rows, columns])])
    return np.concatenate(fused)


def count_violations(
    maps: Sequence[DepthMap], points: Float, min_views: int, margin: float = 0.03, skip: int = -1
) -> NDArray[np.intp]:
    """Returns the number of cameras [P] that see through each of the points [P, 3].

    A camera sees through a point if its trusted depth is behind the point by more than the relative
    ``margin``. The condition must be true of all 3 × 3 pixels around the point, because next to an
    outline, an adjacent pixel may see past the point.

    Args:
        maps: depth maps of the cameras.
        points: [P, 3] points in the world.
        min_views: number of cameras that must agree on a trusted depth.
        margin: minimum relative difference in depth.
        skip: index of a depth map to ignore, or -1.
    """
    through = np.zeros(len(points), dtype=np.intp)
    for index, one in enumerate(maps):
        if index == skip:
            continue
        column, line, depth, inside = pixels_inside(one.view.camera, points)
        certain = minimum_filter(one.trusted(min_views - 1), size=3)
        through += inside & (certain[line, column] > depth * (1.0 + margin))
    return through
