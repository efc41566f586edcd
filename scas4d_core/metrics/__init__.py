"""Metrics that compare images, tracks and parts with ground truth, and the flicker of still pixels."""

from scas4d_core.metrics.benchmarks import (
    BenchmarkScores,
    benchmark_scores,
    mean_trajectory_error,
    scaled_thresholds,
    survival,
    tapvid_thresholds,
)
from scas4d_core.metrics.image import Score, flip, lpips, psnr, ssim
from scas4d_core.metrics.parts import adjusted_rand_index
from scas4d_core.metrics.tracks import (
    TrackError,
    calibration_error,
    error_by_confidence,
    lost_parts,
    median_trajectory_error,
    oracle_tracks,
    track_error_3d,
    visibility_accuracy,
)

__all__ = [
    "BenchmarkScores",
    "Score",
    "TrackError",
    "adjusted_rand_index",
    "benchmark_scores",
    "calibration_error",
    "error_by_confidence",
    "flip",
    "lost_parts",
    "lpips",
    "mean_trajectory_error",
    "median_trajectory_error",
    "oracle_tracks",
    "psnr",
    "scaled_thresholds",
    "ssim",
    "survival",
    "tapvid_thresholds",
    "track_error_3d",
    "visibility_accuracy",
]
