"""Evaluation of a reconstruction against the ground truth of a capture: images, tracks, parts and flicker.

These definitions complement those in ``scas4d_core.metrics``:

- A ground-truth point is *moving* if its distance from its position in frame 0 ever exceeds 1% of the extent.
- *Foreground* pixels are inside the mask of the test camera. *Changed* pixels differ by more than 0.1 in at least one
  channel from the ground-truth image of frame 0.
- 3D tracks start at the ground-truth points in frame 0. 2D tracks start at the pixels of the moving points that are
  visible in a test camera in frame 0. Each track is evaluated only in frames in which its point is visible.
- Scores of the benchmarks TAPVid-3D and MVTracker (``metrics.benchmarks``) are limited to moving points. TAPVid-3D
  queries pixels, and its scores are averaged over test cameras. MVTracker queries points that are visible in any test
  camera; its thresholds are scaled to the extent.
- Parts are rendered twice: with as many labels as the scene has foreground parts, and with the number that
  ``CommittedScene.parts`` finds. The labels are compared at the pixels that show a part in the ground truth. Without
  a given number, static objects get no label, so all static true parts count as one.
- *Still* pixels of a test camera are not black, and their true values vary by at most 6 of 255 levels over the
  evaluated frames. *Flicker* is the mean temporal standard deviation of the rendered values at these pixels, in levels.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core import metrics
from scas4d_core.cameras import Camera
from scas4d_core.captures import Capture
from scas4d_core.gaussians import moving_extent
from scas4d_core.query.tracks import CORRECT_WITHIN

if TYPE_CHECKING:
    from scas4d_core.query.committed import CommittedScene
    from scas4d_core.reconstruction import Reconstruction

    Committed = Reconstruction | CommittedScene
    """A reconstruction or committed scene that contains the evaluated frames."""

MOVING_SHARE = 0.01
"""Maximum distance of a static ground-truth point from its position in frame 0, as a fraction of the extent."""
CHANGED = 0.1
"""A pixel has changed if any channel, in [0, 1], differs from frame 0 by more than this threshold."""
STILL_LEVELS = 6
"""Maximum range of a still pixel's true values in each channel, in 8-bit levels. It allows for image noise."""
MIN_STILL = 500
"""Minimum number of still pixels over all test cameras for which flicker is reported."""

Scores = dict[str, float | None]


def measure_pictures(
    reconstruction: Committed, capture: Capture, index: int, *, with_lpips: bool = False
) -> tuple[Scores, dict[str, Scores]]:
    """Computes the image scores of one frame on the test cameras.

    Args:
        reconstruction: reconstruction in which the frame is already committed.
        capture: capture with test cameras, opened at the image scale to evaluate.
        index: frame index.
        with_lpips: whether to also compute LPIPS, which requires torch.

    Returns:
        The mean scores over all test cameras, and the scores of each camera, keyed by camera name.
    """
    rig, truth, first = capture.test_rig, capture.test_frame(index), capture.test_frame(0)
    assert rig is not None
    by_camera: dict[str, Scores] = {}
    for camera in rig.cameras:
        true = truth.images[camera.name]
        colour = reconstruction.render(camera, index).colour
        mask = truth.masks.get(camera.name)
        changed = np.abs(true / 255.0 - first.images[camera.name] / 255.0).max(axis=-1) > CHANGED
        by_camera[camera.name] = {
            "psnr": metrics.psnr(colour, true),
            "psnr_foreground": None if mask is None else _finite(metrics.psnr(colour, true, mask)),
            "psnr_changed": _finite(metrics.psnr(colour, true, changed)),
            "ssim": metrics.ssim(colour, true),
            "flip": metrics.flip(colour, true).value,
            "lpips": metrics.lpips(colour, true).value if with_lpips else None,
        }
    return mean_scores(by_camera.values()), by_camera


def measure_tracks(reconstruction: Committed, capture: Capture, indices: Sequence[int]) -> Scores:
    """Computes the track scores over the given frames: errors, oracle error, visibility and benchmark scores.

    Args:
        reconstruction: reconstruction in which the frames are already committed.
        capture: capture with test cameras and ground-truth points.
        indices: frame indices, starting with frame 0.

    Returns:
        The scores, or an empty dict if there are fewer than two frames or no point moves.
    """
    truth, rig = capture.ground_truth, capture.test_rig
    assert truth is not None
    assert rig is not None
    points = truth.points[list(indices)]
    extent = capture.extent or float(np.ptp(points.reshape(-1, 3), axis=0).max())
    moving = moving_points(points, extent)
    if len(indices) < 2 or not moving.any():
        return {}
    tracks = reconstruction.tracks_of_points(points[0], indices[0], list(indices))
    error = metrics.track_error_3d(tracks.positions, points, moving, extent)
    sorted_errors = metrics.error_by_confidence(tracks.positions, points, tracks.confidence, moving, extent)
    distances_3d = np.linalg.norm(tracks.positions - points, axis=-1)
    own_extent = moving_extent(reconstruction.history.gaussians(indices[0])) / reconstruction.world.metres_per_unit
    correct = distances_3d[1:, moving] <= CORRECT_WITHIN * own_extent
    calibration = metrics.calibration_error(tracks.confidence[1:, moving], correct)
    at_last = metrics.track_error_3d(tracks.positions[[0, -1]], points[[0, -1]], moving, extent)

    centroids = reconstruction.world.to_user(reconstruction.history.stacked("means", list(indices)))
    by_camera: list[Scores] = []
    seen_anywhere, visible_anywhere = np.zeros((2, *points.shape[:2]), bool)
    for camera in rig.cameras:
        (true_uv, true_depth), visible = camera.project(points), truth.visible_in(camera.name)[list(indices)]
        seen = reconstruction.with_visibility(tracks, camera, indices[0]).visibility[camera.name]
        seen_anywhere |= seen
        visible_anywhere |= visible
        scores: Scores = {"visibility_accuracy": metrics.visibility_accuracy(seen, visible)}
        asked = moving & visible[0]
        if asked.any():
            uv, counted = true_uv[:, asked], visible[:, asked]
            diagonal = math.hypot(camera.width, camera.height)
            measured_tracks = reconstruction.tracks_of_pixels(camera, uv[0], indices[0], list(indices))
            oracle = metrics.oracle_tracks(camera.project(centroids)[0], uv, counted)
            scores["mte_2d"] = _finite(
                metrics.median_trajectory_error(measured_tracks.pixels(camera), uv, counted, diagonal)
            )
            scores["mte_2d_oracle"] = _finite(metrics.median_trajectory_error(oracle, uv, counted, diagonal))
            distances = np.linalg.norm(measured_tracks.positions - points[:, asked], axis=-1)
            thresholds = metrics.tapvid_thresholds(true_depth[:, asked], (camera.fx, camera.fy))
            scores |= _benchmark("tapvid", distances, measured_tracks.visibility[camera.name], counted, thresholds)
        by_camera.append(scores)
    asked = moving & visible_anywhere[0]
    distances = distances_3d[:, asked]
    seen, visible = seen_anywhere[:, asked], visible_anywhere[:, asked]
    return {
        "track_3d_median": _finite(error.median),
        "track_3d_p90": _finite(error.percentile_90),
        "track_3d_last": _finite(at_last.median),
        "track_points": float(moving.sum()),
        "parts_lost": float(len(metrics.lost_parts(tracks.positions, points, truth.part_id, moving, extent))),
        **{f"track_3d_confidence_{k}": _finite(error) for k, error in enumerate(sorted_errors, 1)},
        "track_3d_calibration": _finite(calibration),
        **_benchmark("mvtracker", distances, seen, visible, metrics.scaled_thresholds(extent)),
        "mvtracker_mte": _finite(100 / extent * metrics.mean_trajectory_error(distances, visible)),
        "survival": _finite(metrics.survival(distances, extent)),
        **mean_scores(by_camera),
    }


def _benchmark(
    name: str,
    distances: NDArray[Any],
    seen: NDArray[np.bool_],
    visible: NDArray[np.bool_],
    thresholds: NDArray[Any],
) -> Scores:
    """Returns the benchmark scores of tracks, named after the benchmark; see ``metrics.benchmark_scores``."""
    jaccard, within, occlusion = map(_finite, metrics.benchmark_scores(distances, seen, visible, thresholds))
    return {f"{name}_aj": jaccard, f"{name}_within": within, f"{name}_oa": occlusion}


def measure_parts(reconstruction: Committed, capture: Capture, indices: Sequence[int]) -> Scores:
    """Computes the part scores: part counts, and adjusted Rand indices over all frames and labelled test cameras.

    ``parts_count`` and ``parts_ari`` are those with the true count, and ``parts_count_found`` and ``parts_ari_found``
    those without a given count. The scores are empty if there are fewer than two foreground parts, or if no test camera
    has labels.
    """
    truth, rig = capture.ground_truth, capture.test_rig
    assert truth is not None
    assert rig is not None
    cameras = [camera for camera in rig.cameras if camera.name in truth.label_cameras]
    count = sum(part.foreground for part in truth.parts)
    if count < 2 or not cameras:
        return {}
    given, found = reconstruction.parts(count), reconstruction.parts()
    views = [(camera, index) for camera in cameras for index in indices]
    # Flattened, because image sizes differ between cameras.
    true = np.concatenate([truth.labels(camera.name, index).ravel() for camera, index in views])
    static = [part.id for part in truth.parts if part.static and part.id]
    true_without_static = np.where(np.isin(true, static), max(static, default=0), true)

    def agreement(labels: NDArray[Any], expected: NDArray[Any]) -> float:
        rendered = [render_parts(reconstruction, camera, index, labels).ravel() for camera, index in views]
        return metrics.adjusted_rand_index(np.concatenate(rendered), expected)

    return {
        "parts_ari": agreement(given, true),
        "parts_count": float(count),
        "parts_ari_found": agreement(found, true_without_static),
        "parts_count_found": float(len(np.unique(found[found >= 0]))),
    }


def measure_flicker(reconstruction: Committed, capture: Capture, indices: Sequence[int]) -> Scores:
    """Computes two measures of flicker over the pixels of the test cameras that are still in all frames.

    ``flicker`` is the standard deviation over time, in 8-bit levels. ``mtv`` is the masked total variation: 100 times
    the mean absolute change between consecutive frames, with values in [0, 1] (mTV × 100, as in OR², Kim et al. 2025).
    ``still_pixels`` counts the pixels. Both measures are None if there are fewer than ``MIN_STILL``.
    """
    rig = capture.test_rig
    assert rig is not None
    deviations: list[NDArray[Any]] = []
    variations: list[NDArray[Any]] = []
    for camera in rig.cameras:
        # Frames are loaded one at a time, because a long capture does not fit into memory.
        lowest = highest = capture.test_frame(indices[0]).images[camera.name]
        for index in indices[1:]:
            true = capture.test_frame(index).images[camera.name]
            lowest, highest = np.minimum(lowest, true), np.maximum(highest, true)
        still = ((highest - lowest).max(axis=-1) <= STILL_LEVELS) & (highest.max(axis=-1) > 0)
        mean, squares, changes = (np.zeros((int(still.sum()), 3)) for _ in range(3))
        last: NDArray[np.float64] | None = None
        for count, index in enumerate(indices, 1):
            shown = np.clip(reconstruction.render(camera, index).colour[still], 0, 1).astype(np.float64)
            before = shown - mean
            mean = mean + before / count
            squares = squares + before * (shown - mean)
            changes = changes + (0 if last is None else np.abs(shown - last))
            last = shown
        deviations.append(255 * np.sqrt(squares / len(indices)))
        variations.append(100 * changes / max(1, len(indices) - 1))
    flicker, variation = np.concatenate(deviations), np.concatenate(variations)
    enough = len(flicker) >= MIN_STILL
    return {
        "still_pixels": float(len(flicker)),
        "flicker": float(flicker.mean()) if enough else None,
        "mtv": float(variation.mean()) if enough else None,
    }


def render_parts(reconstruction: Committed, camera: Camera, index: int, labels: NDArray[Any]) -> NDArray[np.uint8]:
    """Renders the part image [H, W] of a camera in one frame: 1 + the part label, or 0 for no part."""
    parts: NDArray[np.uint8] | None = reconstruction.render(camera, index, labels=labels).parts
    assert parts is not None  # labels were given
    return parts


def moving_points(points: NDArray[np.float64], extent: float) -> NDArray[np.bool_]:
    """Returns a mask [P] of the points [T, P, 3] that move more than 1% of the extent from their first position."""
    moving: NDArray[np.bool_] = np.linalg.norm(points - points[:1], axis=-1).max(axis=0) > MOVING_SHARE * extent
    return moving


def mean_scores(of: Iterable[Scores]) -> Scores:
    """Returns the mean of each score over the entries in which it is available, or None if there are none."""
    table = list(of)
    names = dict.fromkeys(name for scores in table for name in scores)
    return {name: _mean([scores.get(name) for scores in table]) for name in names}


def _mean(values: list[float | None]) -> float | None:
    there = [value for value in values if value is not None]
    return float(np.mean(there)) if there else None


def _finite(value: float) -> float | None:
    """Returns the value, or None if it is not finite.

    JSON does not support NaN, and a single infinity (identical pixels, all points lost) would make a mean infinite.
    """
    return value if math.isfinite(value) else None
