"""Initial Gaussians: one for each point of the first cloud, and the budget of Gaussians that a scene may have."""

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
"""The rule for the budget of Gaussians where ``StaticSettings.max_gaussians`` is not set; ``detail`` is a share of it.
Detail lies on objects: a picture that is mostly background needs nearly as many Gaussians as a full one. Beyond the
largest an update takes seconds."""
PLAIN = 2 / 255
"""A pixel this near the background's colour is background."""


def budget(views: list[TrainingView], scene: SceneSettings, settings: StaticSettings) -> int:
    """Largest number of Gaussians of the scene, by the setting or by the size and content of the pictures."""
    if settings.max_gaussians is not None:
        return settings.max_gaussians
    background = np.array(scene.background_rgb, np.float32)[:, None, None]
    pixels = float(np.mean([view.camera.width * view.camera.height for view in views]))
    covered = float(np.mean([(np.abs(view.target[:3] - background).max(axis=0) > PLAIN).mean() for view in views]))
    whole = min(LARGEST_BUDGET, pixels * (PER_PIXEL + PER_COVERED_PIXEL * covered))
    return max(1, int(whole * settings.detail))


def logit(probability: NDArray[np.floating]) -> NDArray[np.floating]:
    """Inverse of the sigmoid, away from its ends."""
    clipped = np.clip(probability, 1e-4, 1 - 1e-4)
    result: NDArray[np.floating] = np.log(clipped / (1 - clipped))
    return result


def initial_parameters(
    positions: NDArray[np.float64], colours: Array, foreground: Array | None, limit: int, rng: np.random.Generator
) -> Array:
    """A row of parameters per point: round Gaussians as wide as the mean distance to their three nearest neighbours.

    Args:
        positions: [P, 3] metres inside. colours: [P, 3] in 0…1. foreground: [P] label or None.
        limit: most Gaussians; of a larger cloud, points are left out at random.
        rng: draws these.
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
