"""Metrics that compare images, tracks and parts with ground truth."""

from scas4d_core.metrics.image import Score, flip, lpips, psnr, ssim
from scas4d_core.metrics.parts import adjusted_rand_index
from scas4d_core.metrics.tracks import (
    TrackError,
    error_by_confidence,
    lost_parts,
    median_trajectory_error,
    oracle_tracks,
    track_error_3d,
    visibility_accuracy,
)

__all__ = [
    "Score",
    "TrackError",
    "adjusted_rand_index",
    "error_by_confidence",
    "flip",
    "lost_parts",
    "lpips",
    "median_trajectory_error",
    "oracle_tracks",
    "psnr",
    "ssim",
    "track_error_3d",
    "visibility_accuracy",
]
