"""Measures the epipolar residual of each camera in pixels, i.e. its calibration error in the images of frame 0."""

from __future__ import annotations

from collections.abc import Sequence
from math import nan
from typing import NamedTuple

import numpy as np

from scas4d_core.first_frame.calibration.matches import Matches, Pair, epipolar_distances
from scas4d_core.first_frame.calibration.report import CameraResidual
from scas4d_core.posed_pictures import Float

NEAR, FAR = 16.0, 80.0
"""Epipolar distance bounds, in pixels. Matches below the first are correct, except for some chance matches. Matches
between the two are wrong and uniformly distributed; their density per pixel estimates the number of chance matches."""
MIN_INLIERS = 30
"""Minimum number of correct matches needed to estimate a camera's residual."""
MIN_INLIER_SHARE = 0.5
"""Minimum fraction of correct matches among those below ``NEAR``; otherwise the distances are due to chance."""
MAX_RESIDUAL, MAX_TIMES_MEDIAN = 0.9, 2.0
"""A camera is off if its residual exceeds both this number of pixels, at the image size of feature detection, and this
multiple of the rig's median. Correct captures have residuals of 0.1 to 0.6 pixels, up to 1.6 times the median; a
camera rotated by two pixels has 0.9 to 2.2 pixels (docs/calibration.md)."""


class ResidualEstimate(NamedTuple):
    """Median distance of correct matches, its lower bound (two standard errors), and the number of these matches."""

    median: float
    lower_bound: float
    inliers: int


def estimate_residual(distances: Float) -> ResidualEstimate:
    """Estimates the median distance of correct matches by subtracting the density of wrong ones.

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
    """Returns each camera's residual relative to correct cameras, keyed by name, and the names of cameras that are off.

    A camera that is off increases the residuals of its neighbours. Therefore, as long as a camera is far worse than
    most, the worst one is excluded and the others are measured again. If most cameras are off, the faulty ones cannot
    be identified, and no names are returned.
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
