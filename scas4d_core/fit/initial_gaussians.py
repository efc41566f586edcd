"""Initial Gaussians of a fit, and the maximum number of Gaussians in a scene.

There is one initial Gaussian for each point of the initial cloud.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scas4d_core.engines.fit import COLOUR, COLUMNS, LABEL, MEAN, OPACITY, SCALE
from scas4d_core.engines.views import TrainingView
from scas4d_core.settings import SceneSettings, StaticSettings

Array = NDArray[np.float32]

INITIAL_OPACITY = 0.1
PER_PIXEL, PER_COVERED_PIXEL, LARGEST_BUDGET = 0.34, 0.27, 100_000
"""Gaussians per pixel, additional Gaussians per covered pixel, and the largest budget. The values
apply if ``StaticSettings.max_gaussians`` is not set, and ``detail`` scales the result. Objects
contain most of the detail, but an image that is mostly background needs nearly as many Gaussians as
a full image. Above the largest budget, an update takes seconds."""
PLAIN = 2 / 255
"""Maximum difference between a background pixel and the background colour."""


def budget(views: list[TrainingView], scene: SceneSettings, settings: StaticSettings) -> int:
    """Returns the maximum number of Gaussians.

    If ``max_gaussians`` is not set, the number depends on the size and content of the images.
    """
    if settings.max_gaussians is not None:
        return settings.max_gaussians
    background = np.array(scene.background_rgb, np.float32)[:, None, None]
    pixels = float(np.mean([view.camera.width * view.camera.height for view in views]))
    covered = float(np.mean([(np.abs(view.target[:3] - background).max(axis=0) > PLAIN).mean() for view in views]))
    whole = min(LARGEST_BUDGET, pixels * (PER_PIXEL + PER_COVERED_PIXEL * covered))
    return max(1, int(whole * settings.detail))


def logit(probability: NDArray[np.floating]) -> NDArray[np.floating]:
    """Returns the inverse sigmoid of a probability, which is clamped to [1e-4, 1 − 1e-4]."""
    clipped = np.clip(probability, 1e-4, 1 - 1e-4)
    result: NDArray[np.floating] = np.log(clipped / (1 - clipped))
    return result


def initial_parameters(
    positions: NDArray[np.float64], colours: Array, foreground: Array | None, limit: int, rng: np.random.Generator
) -> Array:
    """Returns the parameters [P, 15] of isotropic Gaussians, one for each point.

    The width of each Gaussian is the RMS distance to the three nearest points.

    Args:
        positions: [P, 3] positions in metres, in the internal world.
        colours: [P, 3] colours in [0, 1].
        foreground: [P] foreground label of each point in [0, 1], or None.
        limit: maximum number of Gaussians. A larger cloud is subsampled at random.
        rng: random generator for the subsampling.
    """
    if len(positions) > limit:
        keep = np.sort(rng.choice(len(positions), limit, replace=False))
        positions, colours = positions[keep], colours[keep]
        foreground = None if foreground is None else foreground[keep]
    neighbours = min(4, len(positions))
    distances = cKDTree(positions).query(positions, k=neighbours)[0]
    squared = np.square(distances).reshape(len(positions), -1)[:, 1:]
    width = np.sqrt(np.maximum(squared.mean(axis=1), 1e-7)) if neighbours > 1 else np.full(len(positions), 0.05)
    parameters = np.zeros((len(positions), COLUMNS), np.float32)
    parameters[:, MEAN] = positions
    parameters[:, 3] = 1
    parameters[:, SCALE] = np.log(width)[:, None]
    parameters[:, OPACITY] = logit(np.array(INITIAL_OPACITY))
    parameters[:, COLOUR] = colours
    parameters[:, LABEL] = 0 if foreground is None else logit(np.clip(foreground, 0.1, 0.9))[:, None]
    return parameters
