"""Tracks points: each is carried rigidly by the Gaussians that it lies in (paper, Point-Tracking).

A point p, given at frame q, is carried by Gaussian i to frame t as ``μ_i(t) + R_i(t) R_i(q)ᵀ (p − μ_i(q))``, R the
material rotation. Several Gaussians carry every point, and the geometric median of their answers is the track, so
that a single stray Gaussian does not take the point with it. A pixel becomes a point by ``ray_depth``. docs/tracks.md
has the definitions and their accuracy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, maximum_filter

from scas4d_core.cameras import Camera, WorldFrame
from scas4d_core.engines.limits import DEFAULT, Limits
from scas4d_core.errors import InputError
from scas4d_core.gaussians import moving_extent, quaternions_to_matrices
from scas4d_core.query.carriers import carriers, drop_absent, geometric_median
from scas4d_core.query.ray_depth import ray_depths
from scas4d_core.storage.history import History

Float = NDArray[np.float64]
RenderDepth = Callable[[Camera, int], tuple[NDArray[Any], NDArray[Any]]]
"""(camera in the user's world, frame) to z depth [H, W] in the user's units and alpha [H, W]."""

ALPHA_OF_A_SURFACE = 0.5
"""A pixel shows a surface where at least half of it is covered."""
CARRIERS = 32
"""Gaussians that carry a point; 1 is the single nearest. Against 1, the median 3D error falls by 6 % (cloth) to 25 %
(stage)."""
SOFTENING = 0.01
"""Of the extent; added to the axes of a Gaussian (root of the sum of squares) for its distance to a point: surface
Gaussians are flatter than the surface is known, and a wider circle of carriers averages more of their noise. Against
0.001, the median 3D error falls by 2 % (cloth) to 18 % (stage)."""
RAY_SOFTENING = 0.003
"""Of the extent; the same for the place of a Gaussian along the ray of a pixel query."""
AGREEMENT = 0.01
"""Of the extent; carriers whose answers lie this far from the track, on average, halve the confidence."""
DEPTH_TOLERANCE = 0.0075
"""Of the extent; a point counts as seen up to this far behind the rendered depth, which lies about that far from the
surface."""
PIXEL_REACH = 2.0
"""Pixels; a pixel query that misses a silhouette by less takes the nearest covered pixel's depth."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """Trajectories of Q points over T frames.

    Attributes:
        positions: [T, Q, 3] float64, user's world and units; NaN for a pixel query that met no surface, and in frames
            in which none of the Gaussians that carry the point is there (not born yet, or retired).
        confidence: [T, Q] float64 in 0…1: (1 − Π(1 − oᵢ exp(−½ mᵢ²))) / (1 + (s/a)²), the opacity of the carriers at
            the query point (m the Mahalanobis distance) over what their disagreement s in that frame takes away: the
            weighted mean distance of their answers from the track (a = ``AGREEMENT``). 0 for a query that met nothing,
            and where the position is NaN.
        ids: [Q] int64: the Gaussian that carries the point most; −1 for a pixel query that met no surface.
        indices: [T] int64 frames.
        visibility: by camera name, [T, Q] bool, for the cameras queried; see ``find_visibility``.
    """

    positions: Float
    confidence: Float
    ids: NDArray[np.int64]
    indices: NDArray[np.int64]
    visibility: dict[str, NDArray[np.bool_]] = field(default_factory=dict)

    def pixels(self, camera: Camera) -> Float:
        """[T, Q, 2] projections into a camera (user's world), pixels; NaN behind the camera."""
        return camera.project(self.positions)[0]

    def with_visibility(self, camera: Camera, render_depth: RenderDepth, tolerance: float) -> Tracks:
        """Adds the visibility in one more camera; the arguments are those of ``find_visibility``."""
        visible = find_visibility(self.positions, self.indices, camera, render_depth, tolerance)
        return replace(self, visibility={**self.visibility, camera.name: visible})


def tracks_of_points(
    history: History,
    world: WorldFrame,
    points: NDArray[Any],
    index: int,
    indices: Sequence[int],
    count: int = CARRIERS,
) -> Tracks:
    """Carries 3D points through the frames.

    Args:
        history: the committed states.
        world: user's world to inside.
        points: [Q, 3] in the user's world at frame ``index``.
        index: the committed frame that the points are given in.
        indices: the committed frames of the tracks, any order.
        count: Gaussians that carry a point.

    Raises:
        ValueError: points not [Q, 3] or not finite.
        HistoryError: a frame was not committed.

    >>> from scas4d_core.gaussians import Gaussians
    >>> history = History()
    >>> state = Gaussians.of_points([[0, 0, 0], [1, 0, 0]], radius=0.2)
    >>> for index in range(2):
    ...     history.append(index, index / 30, state.replace(means=state.means + np.float32([0, index, 0])))
    >>> world = WorldFrame(np.zeros(3))
    >>> tracks = tracks_of_points(history, world, np.array([[0.1, 0, 0]]), index=0, indices=[0, 1])
    >>> tracks.positions[:, 0]
    array([[0.1, 0. , 0. ],
           [0.1, 1. , 0. ]])
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"points have shape {points.shape}", "give [Q, 3]")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise InputError(
            f"points {bad[:5].tolist()} hold NaN or infinity", "give finite coordinates in the user's units"
        )
    theta = history.gaussians(index)
    extent = moving_extent(theta)
    inside = world.to_inside(points)
    rows, weights, covered = carriers(theta, inside, count, SOFTENING * extent)

    offsets = np.einsum("qkji,qkj->qki", _matrices(theta.rotations[rows]), inside[:, None] - theta.means[rows])
    result = np.empty((len(indices), len(points), 3))
    confidence = np.empty(result.shape[:2])
    for t, frame in enumerate(indices):
        means = history.stacked("means", [frame], rows)[0].astype(np.float64)
        turned = np.einsum("qkij,qkj->qki", _matrices(history.stacked("rotations", [frame], rows)[0]), offsets)
        answers, shares, there = drop_absent(means + turned, weights, history.present(frame)[rows])
        result[t] = geometric_median(answers, shares)
        apart = np.einsum("qk,qk->q", shares, np.linalg.norm(answers - result[t][:, None], axis=-1))
        confidence[t] = covered / (1 + np.square(apart / max(AGREEMENT * extent, 1e-12)))
        result[t][~there], confidence[t][~there] = np.nan, 0
    return Tracks(world.to_user(result), confidence, theta.ids[rows[:, 0]], np.asarray(indices, dtype=np.int64))


def tracks_of_pixels(
    history: History,
    world: WorldFrame,
    camera: Camera,
    uv: NDArray[Any],
    index: int,
    indices: Sequence[int],
    render_depth: RenderDepth,
    limits: Limits = DEFAULT,
) -> Tracks:
    """Carries the surface points at given pixels of one frame of a camera; with their visibility in that camera.

    Args:
        history: the committed states.
        world: user's world to inside.
        camera: in the user's world.
        uv: [Q, 2] pixels, continuous: (0.5, 0.5) is the centre of the first pixel. The depth is that of ``ray_depth``;
            a ray that loses less than half of its light takes the rendered depth of the nearest covered pixel within
            ``PIXEL_REACH``.
        index: the committed frame that ``uv`` is given in.
        indices: the committed frames of the tracks.
        render_depth: rendered depth and alpha.
        limits: the constants that ``render_depth`` renders with.

    Raises:
        ValueError: uv not [Q, 2], not finite or outside the picture.

    >>> from scas4d_core.gaussians import Gaussians
    >>> history = History()
    >>> history.append(0, 0.0, Gaussians.of_points([[0, 0, 2]], radius=0.1))
    >>> camera = Camera("front", [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4), 64, 48)
    >>> def render_depth(camera, index):  # ``CommittedScene`` renders it
    ...     return np.full((48, 64), 2.0), np.ones((48, 64))
    >>> world = WorldFrame(np.zeros(3))
    >>> tracks = tracks_of_pixels(history, world, camera, np.array([[32, 24]]), 0, [0], render_depth)
    >>> tracks.positions[0, 0].round(3), tracks.visibility["front"]
    (array([0.   , 0.   , 1.936]), array([[ True]]))
    """
    uv = np.asarray(uv, dtype=np.float64)
    if uv.ndim != 2 or uv.shape[1] != 2:
        raise InputError(f"uv has shape {uv.shape}", "give [Q, 2] pixels")
    outside = np.flatnonzero(~((uv >= 0) & (uv < (camera.width, camera.height))).all(axis=1))
    if outside.size:
        raise InputError(
            f"pixel {uv[outside[0]].tolist()} (query {outside[0]}) lies outside the picture of camera {camera.name!r}",
            f"give 0 <= u < {camera.width}, 0 <= v < {camera.height}",
        )
    theta = history.gaussians(index)
    softening = RAY_SOFTENING * moving_extent(theta)
    depth, covered = ray_depths(theta, world.camera_to_inside(camera), uv, limits, softening)
    depth /= world.metres_per_unit
    met = covered >= ALPHA_OF_A_SURFACE
    if not met.all():
        rendered, alpha = render_depth(camera, index)
        column, row = uv[~met].astype(np.intp).T
        near, row, column = _covered_near(rendered, alpha, row, column, PIXEL_REACH)
        beside = np.flatnonzero(~met)[near]
        depth[beside], met[beside] = rendered[row[near], column[near]], True
    points = camera.unproject(uv[met], depth[met])
    point_tracks = tracks_of_points(history, world, points, index, indices)
    tracks = Tracks(
        positions=np.full((len(indices), len(uv), 3), np.nan),
        confidence=np.zeros((len(indices), len(uv))),
        ids=np.full(len(uv), -1, dtype=np.int64),
        indices=point_tracks.indices,
    )
    tracks.positions[:, met], tracks.confidence[:, met] = point_tracks.positions, point_tracks.confidence
    tracks.ids[met] = point_tracks.ids
    return tracks.with_visibility(camera, render_depth, depth_tolerance(history, world, index))


def tracks_of_ids(history: History, world: WorldFrame, ids: NDArray[Any], indices: Sequence[int]) -> Tracks:
    """The trajectories of Gaussians' means by id; their confidence is 1, and 0 where they are not there.

    Raises:
        ValueError: an unknown id. HistoryError: a frame was not committed.

    >>> from scas4d_core.gaussians import Gaussians
    >>> history = History()
    >>> history.append(7, 0.0, Gaussians.of_points([[0, 0, 0], [1, 0, 0]], radius=0.2))
    >>> tracks_of_ids(history, WorldFrame(np.zeros(3)), np.array([1]), indices=[7]).positions
    array([[[1., 0., 0.]]])
    """
    wanted = np.asarray(ids, dtype=np.int64).reshape(-1)
    rows = history.known_rows(wanted)
    positions = world.to_user(history.stacked("means", indices, rows))
    there = np.stack([history.present(index)[rows] for index in indices])
    positions[~there] = np.nan
    return Tracks(positions, there.astype(np.float64), wanted, np.asarray(indices, dtype=np.int64))


def depth_tolerance(history: History, world: WorldFrame, index: int) -> float:
    """Tolerance of ``find_visibility``, user's units: ``DEPTH_TOLERANCE`` × extent of the moving Gaussians."""
    return DEPTH_TOLERANCE * moving_extent(history.gaussians(index)) / world.metres_per_unit


def find_visibility(
    positions: Float, indices: Sequence[int] | NDArray[Any], camera: Camera, render_depth: RenderDepth, tolerance: float
) -> NDArray[np.bool_]:
    """Visibility of points in a camera, [T, Q] bool: inside the picture, in front of the camera, and not hidden.

    A point is hidden where it lies more than ``tolerance`` behind the rendered depth, the farthest of the 3×3 pixels
    around its own (tracks are easily off by a pixel, which decides at an edge; on true positions this is right more
    often too). A pixel that is less than half covered hides nothing.

    Args:
        positions: [T, Q, 3] user's world; NaN is never visible.
        indices: [T] committed frames.
        camera: in the user's world.
        render_depth: rendered depth and alpha.
        tolerance: user's units.
    """
    uv, z = camera.project(positions)
    inside = (z > 0) & ((uv >= 0) & (uv < (camera.width, camera.height))).all(axis=-1)
    visible = np.zeros(inside.shape, dtype=np.bool_)
    for t, index in enumerate(indices):
        depth, alpha = render_depth(camera, int(index))
        column, row = uv[t][inside[t]].astype(np.intp).T
        surface = np.where(alpha >= ALPHA_OF_A_SURFACE, depth, -np.inf)
        front = maximum_filter(surface, size=3, mode="nearest")[row, column]
        front[front == -np.inf] = np.inf
        visible[t, inside[t]] = ~(z[t][inside[t]] > front + tolerance)
    return visible


def _covered_near(
    depth: NDArray[Any], alpha: NDArray[Any], row: NDArray[np.intp], column: NDArray[np.intp], reach: float
) -> tuple[NDArray[np.bool_], NDArray[np.intp], NDArray[np.intp]]:
    """Finds the covered pixel nearest to each pixel: true where it is within reach, its row, its column."""
    covered = (alpha >= ALPHA_OF_A_SURFACE) & np.isfinite(depth)
    if not covered.any():
        return np.zeros(len(row), dtype=np.bool_), row, column
    distance, (rows, columns) = distance_transform_edt(~covered, return_indices=True)
    return distance[row, column] <= reach, rows[row, column], columns[row, column]


def _matrices(quaternions: NDArray[Any]) -> Float:
    return quaternions_to_matrices(quaternions.astype(np.float64))
