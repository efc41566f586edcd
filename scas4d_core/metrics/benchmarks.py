"""Track metrics of the benchmarks TAPVid-3D (Koppula et al. 2024) and MVTracker (Rajič et al. 2025).

Both benchmarks report the average Jaccard (AJ), the fraction of positions within thresholds (δ_avg) and the occlusion
accuracy (OA). They differ in their thresholds: back-projected pixels of one camera, or distances in the scene.
The first frame is the query frame, which is excluded, and lost positions (NaN) are farther away than any threshold.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

TAPVID_PIXELS = (1, 2, 4, 8, 16)
"""Thresholds of TAPVid-3D, in pixels at the true depth."""

MVTRACKER_CENTIMETRES = (5, 10, 20, 40)
"""Thresholds of MVTracker for the dataset CMU Panoptic."""

SURVIVAL_CENTIMETRES = 50
"""Error at which a track fails in the metric *survival* (PointOdyssey, Zheng et al. 2023)."""

PERSON_CENTIMETRES = 180
"""Size of the subjects of CMU Panoptic. Scaled thresholds are the same fraction of the subject's extent."""


class BenchmarkScores(NamedTuple):
    """Scores in [0, 1] over tracks and frames, NaN if there are no positions to evaluate.

    Attributes:
        average_jaccard: number of true positives divided by that of true positives, false positives and false
            negatives, averaged over thresholds. A true positive is visible, predicted as visible, and within the
            threshold.
        within: fraction of the visible positions within the threshold, averaged over thresholds (δ_avg).
        occlusion_accuracy: fraction of correct visibility predictions.
    """

    average_jaccard: float
    within: float
    occlusion_accuracy: float


def benchmark_scores(
    errors: NDArray[Any],
    seen: NDArray[np.bool_],
    visible: NDArray[np.bool_],
    thresholds: NDArray[Any],
) -> BenchmarkScores:
    """Returns the scores of tracks by the definitions of TAPVid-3D, pooled over tracks and frames.

    Args:
        errors: [T, Q] distances from the true positions, NaN if lost.
        seen: [T, Q] predicted visibility.
        visible: [T, Q] true visibility.
        thresholds: [K, T, Q] thresholds in the unit of the errors, or an array that broadcasts to this shape.

    >>> errors = np.array([[0.0, 0.0], [0.5, 3.0]])
    >>> everywhere = np.ones((2, 2), bool)
    >>> benchmark_scores(errors, everywhere, everywhere, np.array([1, 4]).reshape(2, 1, 1))
    BenchmarkScores(average_jaccard=0.6666666666666666, within=0.75, occlusion_accuracy=1.0)
    """
    seen, visible = seen[1:], visible[1:]
    with np.errstate(invalid="ignore"):
        near = (errors < np.broadcast_to(thresholds, (len(thresholds), *errors.shape)))[:, 1:]
    true_positives = (near & seen & visible).sum(axis=(1, 2))
    false_positives = (seen & ~(near & visible)).sum(axis=(1, 2))
    if not visible.any():
        return BenchmarkScores(math.nan, math.nan, float((seen == visible).mean()) if visible.size else math.nan)
    jaccard = true_positives / (visible.sum() + false_positives)
    within = (near & visible).sum(axis=(1, 2)) / visible.sum()
    return BenchmarkScores(float(jaccard.mean()), float(within.mean()), float((seen == visible).mean()))


def tapvid_thresholds(depth: NDArray[Any], focal_lengths: tuple[float, float]) -> NDArray[np.float64]:
    """Returns the thresholds of TAPVid-3D: the size of ``TAPVID_PIXELS`` at the true depth.

    Args:
        depth: [T, Q] depth of the true positions in the camera.
        focal_lengths: focal lengths (fx, fy) of the camera in pixels.

    Returns:
        [5, T, Q] thresholds in the unit of the depth.
    """
    size: NDArray[np.float64] = np.asarray(depth, np.float64) / math.sqrt(focal_lengths[0] * focal_lengths[1])
    thresholds: NDArray[np.float64] = np.array(TAPVID_PIXELS, np.float64)[:, None, None] * size
    return thresholds


def scaled_thresholds(extent: float) -> NDArray[np.float64]:
    """Returns the thresholds [4, 1, 1] of MVTracker, scaled from the size of a person to the given extent."""
    thresholds: NDArray[np.float64] = np.array(MVTRACKER_CENTIMETRES, np.float64) * (extent / PERSON_CENTIMETRES)
    return thresholds[:, None, None]


def survival(errors: NDArray[Any], extent: float) -> float:
    """Returns the mean fraction of frames before a track fails for the first time.

    A track fails if its error exceeds 50 cm, scaled from the size of a person to the extent, or if it is lost.

    Args:
        errors: [T, Q] distances from the true positions, NaN if lost.
        extent: extent of the subject, in the unit of the errors.

    >>> survival(np.array([[0.0, 0.0], [0.1, 0.9], [np.nan, 0.1]]), extent=1.0)
    0.25
    """
    with np.errstate(invalid="ignore"):
        alive = errors[1:] <= extent * SURVIVAL_CENTIMETRES / PERSON_CENTIMETRES
    return float(np.logical_and.accumulate(alive, axis=0).mean()) if alive.size else math.nan


def mean_trajectory_error(errors: NDArray[Any], visible: NDArray[np.bool_]) -> float:
    """Returns the error MTE of MVTracker: the median of each track over its visible frames, averaged over tracks.

    Args:
        errors: [T, Q] distances from the true positions, NaN if lost.
        visible: [T, Q] true visibility. Tracks that are visible only in the query frame are ignored.

    Returns:
        Error in the unit of the errors, infinite if a track is mostly lost, NaN if there are no tracks.

    >>> mean_trajectory_error(np.array([[0.0, 0.0], [1.0, 2.0], [3.0, 4.0]]), np.ones((3, 2), bool))
    2.5
    """
    counted = visible.copy()
    counted[0] = False
    finite = np.where(np.isfinite(errors), errors, np.inf)
    medians = [np.median(finite[counted[:, k], k]) for k in np.flatnonzero(counted.any(axis=0))]
    return float(np.mean(medians)) if medians else math.nan
