"""Metrics that compare point tracks with ground truth.

If a track has no finite position in a frame, because it is lost or behind the camera, its error is one image diagonal
in 2D and infinity in 3D. The first frame is the query frame, which is excluded, because its positions are given.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

ORACLE_RADIUS_PX = 10.0
"""Radius around a true point, in pixels, within which the oracle selects a candidate (paper, Point-Tracking)."""

LOST_PERCENT = 2.0
"""A part is lost if the median error of its points exceeds this threshold, in percent of the extent."""


@dataclass(frozen=True)
class TrackError:
    """Track errors in percent of the extent, pooled over points and frames.

    Attributes:
        median: median error in %; infinite if at least half of the positions are lost.
        percentile_90: 90th percentile in %: the smallest observed error that 90% of the errors do not exceed.
        count: number of evaluated positions.
    """

    median: float
    percentile_90: float
    count: int


def median_trajectory_error(
    tracks: NDArray[Any],
    truth: NDArray[Any],
    counted: NDArray[np.bool_],
    diagonal: float,
) -> float:
    """Returns the 2D median trajectory error (MTE) in % of the image diagonal.

    The MTE is the median pixel error of each track, averaged over tracks. As in Dynamic 3D Gaussians, the definition
    follows PointOdyssey (Zheng et al. 2023, ``median_l2``), but excludes the query frame. As in the paper
    (Point-Tracking), it is normalized by the image diagonal.

    Args:
        tracks: [T, Q, 2] predicted positions in pixels, NaN if lost.
        truth: [T, Q, 2] true positions in pixels.
        counted: [T, Q] bool mask of the positions to evaluate, i.e. those visible in the camera. Tracks without such
            positions are ignored.
        diagonal: image diagonal in pixels.

    Returns:
        Error in %, or NaN if there are no positions to evaluate.

    Raises:
        ValueError: if the shapes differ, or if the diagonal is not positive.

    >>> truth = np.zeros((3, 1, 2))
    >>> tracks = truth + [[[0, 0]], [[3, 4]], [[3, 4]]]
    >>> median_trajectory_error(tracks, truth, np.ones((3, 1), bool), diagonal=100)
    5.0
    """
    errors = _percent_of_diagonal(tracks, truth, diagonal)
    medians = _medians(errors, _without_query(counted, errors.shape))
    return float(np.mean(medians)) if len(medians) else math.nan


def oracle_tracks(
    candidates: NDArray[Any],
    truth: NDArray[Any],
    counted: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Returns oracle tracks, which follow the best candidate near each point, as defined in the paper.

    Among the candidates within ``ORACLE_RADIUS_PX`` of a point in the query frame, the oracle selects the one with the
    smallest error. Without a candidate there, a case that the paper does not specify, it uses the nearest one. The
    oracle uses the ground truth, so the ``median_trajectory_error`` of these tracks is a bound on the accuracy of
    centroids and does not measure tracking. Report this error together with the error of the actual tracks.

    Args:
        candidates: [T, N, 2] positions of all Gaussian centroids in pixels, NaN behind the camera.
        truth: [T, Q, 2] true positions in pixels.
        counted: [T, Q] bool mask of the positions to evaluate.

    Returns:
        [T, Q, 2] tracks of the selected candidates.

    Raises:
        ValueError: if the shapes do not match, or if no candidate is in front of the camera.

    >>> truth = np.zeros((2, 1, 2))
    >>> candidates = np.array([[[1, 0], [2, 0]], [[9, 0], [0, 0]]], float)  # [T, N, 2]
    >>> oracle_tracks(candidates, truth, np.ones((2, 1), bool))[:, 0]  # the second candidate has the better track
    array([[2., 0.],
           [0., 0.]])
    """
    if candidates.ndim != 3 or candidates.shape[0] != truth.shape[0] or candidates.shape[2] != 2:
        raise ValueError(f"candidates must have shape [T={truth.shape[0]}, N, 2]; got {candidates.shape}")
    present = np.flatnonzero(np.isfinite(candidates[0]).all(axis=-1))
    if len(present) == 0:
        raise ValueError("no candidate is in front of the camera in the query frame")
    tree = cKDTree(candidates[0, present])
    counts = _without_query(counted, truth.shape[:2])
    chosen = np.empty(truth.shape, dtype=np.float64)
    for point in range(truth.shape[1]):
        near = tree.query_ball_point(truth[0, point], ORACLE_RADIUS_PX)
        rows = present[near] if near else present[[int(tree.query(truth[0, point])[1])]]
        paths = candidates[:, rows].astype(np.float64)
        best = 0
        if counts[:, point].any():
            errors = np.linalg.norm(paths - truth[:, point : point + 1], axis=-1)[counts[:, point]]
            best = int(np.argmin(np.median(np.where(np.isfinite(errors), errors, np.inf), axis=0)))
        chosen[:, point] = paths[:, best]
    return chosen


def track_error_3d(
    tracks: NDArray[Any], truth: NDArray[Any], moving: NDArray[np.bool_], extent: float, *, query: int = 0
) -> TrackError:
    """Returns the 3D track error in % of the extent, pooled over moving points and all frames except the query frame.

    Args:
        tracks: [T, P, 3] predicted positions in user units, not finite if lost.
        truth: [T, P, 3] true positions in user units.
        moving: [P] bool mask of the moving points. Static points are not evaluated, because they would lower the
            median.
        extent: longest side of the foreground's bounding box, in user units.
        query: index in T of the query frame, which is excluded from the error.

    Raises:
        ValueError: if the shapes differ, if the extent is not positive, or if there is nothing to evaluate.

    >>> truth = np.zeros((3, 4, 3))
    >>> track_error_3d(truth + [0, 0, 0.25], truth, moving=np.ones(4, bool), extent=2.0)
    TrackError(median=12.5, percentile_90=12.5, count=8)
    """
    if tracks.shape != truth.shape or truth.ndim != 3 or truth.shape[2] != 3 or moving.shape != truth.shape[1:2]:
        raise ValueError(
            "tracks and truth must have shape [T, P, 3], and moving [P]; got "
            f"{tracks.shape}, {truth.shape} and {moving.shape}"
        )
    if not extent > 0:
        raise ValueError(f"extent must be positive; got {extent!r}")
    distances = np.linalg.norm(tracks.astype(np.float64) - truth.astype(np.float64), axis=-1)
    frames = np.arange(len(truth)) != query
    pooled = distances[np.ix_(frames, moving)].ravel()
    if pooled.size == 0:
        raise ValueError("nothing to evaluate: no point moves, or there is no frame other than the query frame")
    pooled = np.where(np.isfinite(pooled), pooled, np.inf) * (100.0 / extent)
    # Use the inverted CDF, because interpolating between two infinities yields NaN.
    ninety = np.quantile(pooled, 0.9, method="inverted_cdf")
    return TrackError(float(np.median(pooled)), float(ninety), int(pooled.size))


def lost_parts(
    tracks: NDArray[Any], truth: NDArray[Any], part_id: NDArray[Any], moving: NDArray[np.bool_], extent: float
) -> list[int]:
    """Returns the ids of all lost parts, whose median error in the last frame exceeds ``LOST_PERCENT``.

    Args:
        tracks: [T, P, 3] predicted positions in user units, not finite if lost.
        truth: [T, P, 3] true positions in user units.
        part_id: [P] part id of each point.
        moving: [P] bool mask of the points to evaluate.
        extent: extent of the scene in user units; see ``track_error_3d``.

    Raises:
        ValueError: see ``track_error_3d``.

    >>> truth = np.zeros((2, 4, 3))
    >>> tracks = truth + np.array([0.1, 0.0, 0.5, 0.4])[:, None]
    >>> lost_parts(tracks, truth, np.array([1, 1, 2, 2]), np.ones(4, bool), extent=10.0)
    [2]
    """
    return [
        int(part)
        for part in np.unique(part_id[moving])
        if track_error_3d(tracks[-1:], truth[-1:], moving & (part_id == part), extent, query=-1).median > LOST_PERCENT
    ]


def error_by_confidence(
    tracks: NDArray[Any],
    truth: NDArray[Any],
    confidence: NDArray[Any],
    moving: NDArray[np.bool_],
    extent: float,
    groups: int = 4,
) -> list[float]:
    """Returns the median 3D error of each group of positions, in % of the extent, most confident group first.

    The evaluated positions are the same as in ``track_error_3d``. They are sorted by confidence and divided into groups
    of equal size. If the confidence is meaningful, errors increase from group to group.

    Args:
        tracks: [T, P, 3] predicted positions in user units.
        truth: [T, P, 3] true positions in user units.
        confidence: [T, P] confidence of each predicted position.
        moving: [P] bool mask of the points to evaluate.
        extent: extent of the scene in user units; see ``track_error_3d``.
        groups: number of groups. If positions cannot be divided evenly, the least confident ones are ignored. With
            fewer positions than groups, all errors are NaN.

    Raises:
        ValueError: if the confidence has a different shape; see also ``track_error_3d``.

    >>> truth = np.zeros((2, 4, 3))
    >>> tracks = truth + np.array([1, 2, 3, 4])[:, None] * [1, 0, 0]
    >>> confidence = np.broadcast_to([0.9, 0.7, 0.5, 0.1], (2, 4))
    >>> error_by_confidence(tracks, truth, confidence, np.ones(4, bool), extent=100, groups=2)
    [1.5, 3.5]
    """
    if confidence.shape != tracks.shape[:2]:
        raise ValueError(f"confidence must have shape [T, P] = {tracks.shape[:2]}; got {confidence.shape}")
    track_error_3d(tracks, truth, moving, extent)  # validates the arguments
    chosen = np.ix_(np.arange(len(truth)) != 0, moving)
    distances = np.linalg.norm(tracks.astype(np.float64) - truth.astype(np.float64), axis=-1)[chosen].ravel()
    distances = np.where(np.isfinite(distances), distances, np.inf) * (100.0 / extent)
    order = np.argsort(-confidence[chosen].ravel(), kind="stable")
    size = len(order) // groups
    return [float(np.median(distances[order[k * size : (k + 1) * size]])) if size else math.nan for k in range(groups)]


def calibration_error(confidence: NDArray[Any], correct: NDArray[np.bool_], bins: int = 10) -> float:
    """Returns the expected calibration error (ECE, Naeini et al. 2015) in [0, 1], NaN without positions.

    Positions are divided into bins of equal width by confidence. The error is the difference between the mean
    confidence of a bin and its fraction of correct positions, averaged over positions.

    Args:
        confidence: confidence of each position, in [0, 1].
        correct: whether each position is correct, in the same shape.
        bins: number of bins.

    Raises:
        ValueError: if the shapes differ.

    >>> round(calibration_error(np.array([0.8, 0.8, 0.8, 0.8]), np.array([True, True, True, False])), 3)
    0.05
    """
    if confidence.shape != correct.shape:
        raise ValueError(f"confidence and correct must have the same shape; got {confidence.shape}, {correct.shape}")
    if not correct.size:
        return math.nan
    bin_of = np.minimum((bins * confidence).astype(int), bins - 1).ravel()
    excess = np.bincount(bin_of, weights=(confidence - correct).ravel(), minlength=bins)
    return float(np.abs(excess).sum() / correct.size)


def visibility_accuracy(predicted: NDArray[np.bool_], truth: NDArray[np.bool_]) -> float:
    """Returns the fraction of correct visibility predictions in [0, 1], called occlusion accuracy in TAP-Vid.

    The fraction is NaN if there is no frame other than the query frame.

    Args:
        predicted: [T, Q] bool predicted visibility.
        truth: [T, Q] bool true visibility.

    Raises:
        ValueError: if the shapes differ.

    >>> truth = np.array([[True, True], [True, False]])
    >>> visibility_accuracy(np.ones((2, 2), bool), truth)  # the query frame does not count
    0.5
    """
    if predicted.shape != truth.shape or truth.ndim != 2:
        raise ValueError(f"predicted and truth must both have shape [T, Q]; got {predicted.shape} and {truth.shape}")
    right = predicted[1:] == truth[1:]
    return float(right.mean()) if right.size else math.nan


def _percent_of_diagonal(tracks: NDArray[Any], truth: NDArray[Any], diagonal: float) -> NDArray[np.float64]:
    if tracks.shape != truth.shape or truth.ndim != 3 or truth.shape[2] != 2:
        raise ValueError(f"tracks and truth must both have shape [T, Q, 2]; got {tracks.shape} and {truth.shape}")
    if not diagonal > 0:
        raise ValueError(f"diagonal must be a positive number of pixels; got {diagonal!r}")
    distances = np.linalg.norm(tracks.astype(np.float64) - truth.astype(np.float64), axis=-1)
    percent: NDArray[np.float64] = np.where(np.isfinite(distances), distances, diagonal) * (100.0 / diagonal)
    return percent


def _without_query(counted: NDArray[np.bool_], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    if counted.shape != shape:
        raise ValueError(f"counted must have shape [T, Q] = {shape}; got {counted.shape}")
    counts = counted.astype(np.bool_)
    counts[0] = False
    return counts


def _medians(errors: NDArray[np.float64], counts: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Returns the median of each column over the selected rows. Columns without selected rows are omitted."""
    columns = [np.median(errors[counts[:, column], column]) for column in np.flatnonzero(counts.any(axis=0))]
    return np.array(columns, dtype=np.float64)
