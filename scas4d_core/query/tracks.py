"""Point tracking: each point is carried rigidly by the Gaussians that contain it (paper, Point-Tracking).

Gaussian i carries a point p from frame q to frame t as ``μ_i(t) + R_i(t) R_i(q)ᵀ (p − μ_i(q))``, where R is the
material rotation. Several Gaussians carry each point, and the track is the geometric median of their predictions, so a
single outlier cannot displace the point. Pixels are converted to points with ``ray_depth``. See docs/tracks.md for
definitions and accuracy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from scas4d_core.cameras import Camera, WorldFrame
from scas4d_core.engines.limits import DEFAULT, Limits
from scas4d_core.errors import InputError
from scas4d_core.gaussians import moving_extent, quaternions_to_matrices
from scas4d_core.query.carriers import carriers, drop_absent, geometric_median
from scas4d_core.query.ray_depth import RAY_SOFTENING, ray_depths
from scas4d_core.query.visibility import find_visibility
from scas4d_core.storage.history import History

Float = NDArray[np.float64]
RenderDepth = Callable[[Camera, int], tuple[NDArray[Any], NDArray[Any]]]
"""Function that renders a frame from a camera in the user's world: z depth [H, W] in user units, and alpha [H, W]."""

ALPHA_OF_A_SURFACE = 0.5
"""Minimum alpha of a pixel that counts as showing a surface."""
CARRIERS = 32
"""Number of Gaussians that carry a point. Compared with using only the nearest Gaussian, the median 3D error decreases
by 6% (cloth) to 25% (stage)."""
SOFTENING = 0.01
"""Length added in quadrature to a Gaussian's axes when computing its distance to a point, as a fraction of the extent.
Gaussians are thinner than the uncertainty of the surface, and more carriers average out more noise. Compared with
0.001, the median 3D error decreases by 2% (cloth) to 18% (stage)."""
CORRECT_WITHIN = 0.01
"""Maximum error of a correct position, as a fraction of the extent. The confidence is the probability that a position
is correct."""
COVERED = 0.3
"""Opacity of the carriers at a point from which it lies on a reconstructed surface."""
ODDS = 0.26
"""Factor of the odds of a wrong position; see ``confidence_of``. It is fitted together with ``DISAGREEMENT`` and
``AGEING``, for given ``NOISE`` and ``FRAME_OFFSET`` (`scripts/bench confidence`)."""
NOISE, DISAGREEMENT = 0.1, 1.4
"""Disagreement of correct carriers, as a fraction of ``CORRECT_WITHIN``, and exponent of the disagreement."""
FRAME_OFFSET, AGEING = 3.0, 0.7
"""Number added to the number of frames from the query, and its exponent."""
PIXEL_REACH = 2.0
"""Maximum distance, in pixels, from a query without a surface to the covered pixel whose depth is used instead."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """Trajectories of Q points over T frames.

    Attributes:
        positions: [T, Q, 3] float64 positions in the user's world and units. NaN for a pixel query without a surface,
            and in frames in which too few of the carriers are present (not yet added, or retired).
        confidence: [T, Q] float64 in [0, 1], estimated probability that the position is correct; see
            ``confidence_of``. It is 0 for a query without a surface, and if the position is NaN.
        ids: [Q] int64 id of the Gaussian with the largest weight; −1 for a pixel query without a surface.
        indices: [T] int64 frame indices.
        visibility: maps the name of each queried camera to the visibility [T, Q] bool; see ``find_visibility``.
    """

    positions: Float
    confidence: Float
    ids: NDArray[np.int64]
    indices: NDArray[np.int64]
    visibility: dict[str, NDArray[np.bool_]] = field(default_factory=dict)

    def pixels(self, camera: Camera) -> Float:
        """Returns the pixels [T, Q, 2] of the tracks in a camera in the user's world, NaN behind the camera."""
        return camera.project(self.positions)[0]

    def with_visibility(
        self, history: History, world: WorldFrame, camera: Camera, index: int, limits: Limits = DEFAULT
    ) -> Tracks:
        """Returns a copy with the visibility in another camera added; see ``find_visibility`` for the arguments."""
        visible = find_visibility(history, world, self.positions, self.indices, camera, index, limits)
        return replace(self, visibility={**self.visibility, camera.name: visible})


def tracks_of_points(
    history: History,
    world: WorldFrame,
    points: NDArray[Any],
    index: int,
    indices: Sequence[int],
    count: int = CARRIERS,
) -> Tracks:
    """Tracks 3D points over the given frames.

    Args:
        history: history of committed states.
        world: transform from the user's world to the internal world.
        points: [Q, 3] points in the user's world at frame ``index``.
        index: committed frame in which the points are given.
        indices: committed frames over which to track the points, in any order.
        count: number of Gaussians that carry each point.

    Raises:
        ValueError: if the points do not have shape [Q, 3], or are not finite.
        HistoryError: if a frame was not committed.

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
        raise InputError(f"points have shape {points.shape}", "expected [Q, 3]")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise InputError(
            f"points {bad[:5].tolist()} contain NaN or infinity", "use finite coordinates in the user's units"
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
        confidence[t] = confidence_of(covered, apart / max(extent, 1e-12), abs(frame - index))
        result[t][~there], confidence[t][~there] = np.nan, 0
    return Tracks(world.to_user(result), confidence, theta.ids[rows[:, 0]], np.asarray(indices, dtype=np.int64))


def confidence_of(
    covered: Float,
    disagreement: Float,
    frames: int | Float,
    constants: tuple[float, float, float] = (ODDS, DISAGREEMENT, AGEING),
) -> Float:
    """Returns the probability that a position is within ``CORRECT_WITHIN`` of the true one.

    The formula is a logistic regression on captures with known tracks. It does not reveal that a whole surface moves
    incorrectly.

    Args:
        covered: [Q] opacity of the carriers at each queried point.
        disagreement: [Q] weighted mean distance of the carriers' positions from the track, as a fraction of the extent.
        frames: number of frames from the query.
        constants: ``ODDS``, ``DISAGREEMENT`` and ``AGEING``, which a fit varies.

    >>> confidence_of(np.array([0.9, 0.9, 0.1]), np.array([0.0, 0.01, 0.0]), frames=7).round(2)
    array([0.95, 0.4 , 0.32])
    """
    factor, exponent, ageing = constants
    odds = factor * (disagreement / CORRECT_WITHIN + NOISE) ** exponent * (frames + FRAME_OFFSET) ** ageing
    confidence: Float = np.minimum(1, covered / COVERED) / (1 + odds)
    return confidence


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
    """Tracks the surface points that a camera sees at given pixels of one frame, with their visibility in that camera.

    Args:
        history: history of committed states.
        world: transform from the user's world to the internal world.
        camera: camera in the user's world.
        uv: [Q, 2] continuous pixel positions: (0.5, 0.5) is the centre of the first pixel. Their depth is computed by
            ``ray_depth``. For a ray that loses less than half of its light, the rendered depth of the nearest covered
            pixel within ``PIXEL_REACH`` is used.
        index: committed frame in which the pixels are given.
        indices: committed frames over which to track the points.
        render_depth: function that returns rendered depth and alpha.
        limits: rasterizer constants that ``render_depth`` uses.

    Raises:
        ValueError: if the pixels do not have shape [Q, 2], are not finite, or are outside the image.
        HistoryError: if a frame was not committed.

    >>> from scas4d_core.gaussians import Gaussians
    >>> history = History()
    >>> history.append(0, 0.0, Gaussians.of_points([[0, 0, 2]], radius=0.1))
    >>> camera = Camera("front", [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4), 64, 48)
    >>> def render_depth(camera, index):  # normally rendered by ``CommittedScene``
    ...     return np.full((48, 64), 2.0), np.ones((48, 64))
    >>> world = WorldFrame(np.zeros(3))
    >>> tracks = tracks_of_pixels(history, world, camera, np.array([[32, 24]]), 0, [0], render_depth)
    >>> tracks.positions[0, 0].round(3), tracks.visibility["front"]
    (array([0.   , 0.   , 1.936]), array([[ True]]))
    """
    uv = np.asarray(uv, dtype=np.float64)
    if uv.ndim != 2 or uv.shape[1] != 2:
        raise InputError(f"uv has shape {uv.shape}", "expected [Q, 2] pixels")
    outside = np.flatnonzero(~camera.in_image(uv))
    if outside.size:
        raise InputError(
            f"pixel {uv[outside[0]].tolist()} (query {outside[0]}) is outside the image of camera {camera.name!r}",
            f"use 0 <= u < {camera.width}, 0 <= v < {camera.height}",
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
    return tracks.with_visibility(history, world, camera, index, limits)


def tracks_of_ids(history: History, world: WorldFrame, ids: NDArray[Any], indices: Sequence[int]) -> Tracks:
    """Returns the trajectories of the Gaussians with the given ids.

    The confidence is 1 in frames in which a Gaussian is present, and 0 in all other frames.

    Raises:
        ValueError: if an id is unknown.
        HistoryError: if a frame was not committed.

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


def _covered_near(
    depth: NDArray[Any], alpha: NDArray[Any], row: NDArray[np.intp], column: NDArray[np.intp], reach: float
) -> tuple[NDArray[np.bool_], NDArray[np.intp], NDArray[np.intp]]:
    """Returns whether the covered pixel nearest to each given pixel is within reach, with its row and its column."""
    covered = (alpha >= ALPHA_OF_A_SURFACE) & np.isfinite(depth)
    if not covered.any():
        return np.zeros(len(row), dtype=np.bool_), row, column
    distance, (rows, columns) = distance_transform_edt(~covered, return_indices=True)
    return distance[row, column] <= reach, rows[row, column], columns[row, column]


def _matrices(quaternions: NDArray[Any]) -> Float:
    return quaternions_to_matrices(quaternions.astype(np.float64))
