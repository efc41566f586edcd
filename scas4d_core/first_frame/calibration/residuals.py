"""Calibration error of each camera, measured as an epipolar residual in the images of frame 0."""

from __future__ import annotations

from collections.abc import Sequence
from math import nan
from typing import NamedTuple

import numpy as np

from scas4d_core.first_frame.calibration.matches import Matches, Pair, epipolar_distances
from scas4d_core.first_frame.calibration.report import CameraResidual
from scas4d_core.posed_pictures import Float

NEAR, FAR = 16.0, 80.0
"""Bounds of the epipolar distance, in pixels. Matches below the first bound are correct, except for
some chance matches. Matches between the two bounds are wrong and uniformly distributed. The density
of wrong matches per pixel yields the number of chance matches."""
MIN_INLIERS = 30
"""Minimum number of correct matches needed to estimate a camera's residual."""
MIN_INLIER_SHARE = 0.5
"""Minimum fraction of correct matches among all matches below ``NEAR``. If the fraction is lower,
the distances are due to chance."""
MAX_RESIDUAL, MAX_TIMES_MEDIAN = 0.9, 2.0
"""Residual in pixels, at the image size of feature detection, and multiple of the rig's median
residual. A camera is off if its residual exceeds both. Correct captures have residuals of 0.1 to
0.6 pixels, up to 1.6 times the median. A camera that is rotated by two pixels has a residual of 0.9
to 2.2 pixels (docs/calibration.md)."""


class ResidualEstimate(NamedTuple):
    """Residual of a camera, estimated from its correct matches.

    Attributes:
        median: median epipolar distance of the correct matches in pixels, or NaN if there are too
            few correct matches.
        lower_bound: lower bound of the median, two standard errors below the median, or NaN.
        inliers: number of correct matches.
    """

    median: float
    lower_bound: float
    inliers: int


def estimate_residual(distances: Float) -> ResidualEstimate:
    """Estimates the median distance of correct matches by subtracting the density of wrong matches.

    Args:
        distances: [M] epipolar distances of correct and wrong matches, in pixels.

    >>> right, wrong = np.linspace(0, 1, 101), np.linspace(0, 80, 81)
    >>> estimate_residual(np.concatenate([right, wrong]))
    ResidualEstimate(median=0.49, lower_bound=0.39, inliers=101)
    """
    ordered = np.sort(distances)
    near = int(np.searchsorted(ordered, NEAR))
    density = (int(np.searchsorted(ordered, FAR)) - near) / (FAR - NEAR)
    right = near - density * NEAR
    if right < MIN_INLIERS or right < MIN_INLIER_SHARE * near:
        return ResidualEstimate(nan, nan, max(0, round(right)))
    surplus = np.arange(1, near + 1) - density * ordered[:near]
    median, least = (float(ordered[int(np.argmax(surplus >= rank))]) for rank in (right / 2, right / 2 - right**0.5))
    return ResidualEstimate(median, least, round(right))


def measure_residuals(matches: Matches) -> tuple[dict[str, CameraResidual], list[str]]:
    """Measures the residual of each camera relative to correctly calibrated cameras.

    A camera that is off increases the residuals of its neighbours. Therefore, as long as a camera
    is far worse than most cameras, the worst camera is excluded and all residuals are measured
    again. If more than half of the cameras would be excluded, the faulty cameras cannot be
    identified.

    Returns:
        The residual of each camera, keyed by name, and the names of the cameras that are off. If
        the faulty cameras cannot be identified, no names are returned.
    """
    measured = [(pair, epipolar_distances(matches, pair)) for pair in matches.pairs]
    off: list[int] = []
    while True:
        camera_residuals = [_of_camera(index, measured, off) for index in range(len(matches.cameras))]
        known = {
            index: one for index, one in enumerate(camera_residuals) if not np.isnan(one.median) and index not in off
        }
        worst = max(known, key=lambda index: known[index].lower_bound, default=None)
        if worst is None or known[worst].lower_bound <= max(
            MAX_RESIDUAL, MAX_TIMES_MEDIAN * float(np.median([m for m, *_ in known.values()]))
        ):
            break
        off.append(worst)
        if 2 * len(off) >= len(known) + len(off):
            off = []
            camera_residuals = [_of_camera(index, measured, off) for index in range(len(matches.cameras))]
            break
    cameras = {
        camera.name: CameraResidual(one.median * float(scale), one.inliers)
        for camera, scale, one in zip(matches.cameras, matches.scale, camera_residuals, strict=True)
    }
    return cameras, [matches.cameras[index].name for index in sorted(off)]


def _of_camera(index: int, measured: Sequence[tuple[Pair, Float]], off: Sequence[int]) -> ResidualEstimate:
    """Estimates the residual of a camera from its matches with cameras that are not off."""
    own = [distances for pair, distances in measured if index in pair and not {*pair} - {index} & {*off}]
    return estimate_residual(np.concatenate([*own, np.zeros(0)]))
