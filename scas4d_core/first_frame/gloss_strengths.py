"""Gloss strengths, estimated from the images of frame 0.

The gloss strength of a Gaussian describes how strongly its colour follows the predicted reflection.
Gradient descent leaves matte objects with half of their initial gloss, because their gradients are
small. Such objects then show highlights in novel views. Here, the normals and the environment are
given, and the strength is the slope of a regression line.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scas4d_core.engines.cpu.gloss import SAME_SIDE, without_turn
from scas4d_core.engines.renderer import Renderer
from scas4d_core.engines.views import TrainingView
from scas4d_core.gaussians import Gaussians

Array = NDArray[np.float32]
Float = NDArray[np.float64]

ENOUGH = 0.05
"""Minimum blending weight of a Gaussian in a view, in pixels, for its colour in that view to be used."""
WHITE = 0.97
"""Channel value, in [0, 1], from which a colour is treated as saturated."""
FLATTEST = 0.2
"""Minimum cosine between the normal of a Gaussian and the direction to the camera. Gaussians at smaller
cosines extend beyond the outline of the object in the image."""
NEAR = 64
"""Number of neighbours over which a slope is estimated. A single Gaussian rarely reflects two
highlights."""
CLEAR = 0.3
"""Fraction of the light variation that the regression line must explain for full confidence in its
slope. If the line explains less, the confidence is proportional to the explained fraction."""
ROUNDS = 3
"""Number of rounds of averaging over neighbours, which infers uncertain strengths from reliable
strengths nearby."""
GLOSSY = 0.12
"""Minimum fraction of the light variation that regression lines must explain, on average, around a
point of a glossy surface. On frame 0 of `gloss`, the median fraction is 0.005 on the matte stand, and
0.25 and 0.17 on vase and ring. Below this minimum, strengths decrease to 0. Without this decrease, the
stand kept the initial strength of 0.5 in places that reflect no lamp, and false highlights cost 0.3 dB
over all images."""
FAINTEST, STRONGEST = 0.004, 1.0
"""Minimum and maximum strength. A strength of 0 would leave the normal undefined."""
TINY = 1e-12


def estimate_strengths(
    normals: Array, environment: Array, state: Gaussians, views: Sequence[TrainingView], renderer: Renderer
) -> Array:
    """Returns the gloss strengths [N, 1] of the Gaussians.

    The light of a Gaussian is its squared colour in an image. Over the views, the light is a linear
    function of the predicted reflection, and the slope of this line is the strength. The slope is
    estimated over neighbours on the same side of the surface. If the line explains little, the
    strength is taken from reliable neighbours, or is near 0 if there are none.

    Args:
        normals: [N, 3] unit surface normals.
        environment: [ROWS, 3] reflected environment.
        state: Gaussians of the surface.
        views: training views, including their images.
        renderer: renderer used to compute blending weights.
    """
    from scas4d_core.kernels.appearance.direction import DARK, FALL, OVER, shade

    means, count = state.means, len(state)
    shown = np.zeros((count, 4), np.float32)
    sums = np.zeros((6, count, 3))  # sums of weights, light, reflection, reflection × light, reflection², light²
    for view in views:
        gain, offset = view.exposure[:3, :1, None], view.exposure[:3, 1:, None]
        planes = np.ones((4, *view.target.shape[1:]), np.float32)
        planes[:3] = (view.target[:3] - offset) / gain
        blended = renderer.gather(state, view.camera, planes)
        colours = blended[:, :3] / np.maximum(blended[:, 3:], 1e-6)
        centre = view.camera.centre
        ahead = centre - means
        facing = np.einsum("nc,nc->n", ahead, normals) / np.maximum(np.linalg.norm(ahead, axis=1), 1e-9)
        counts = (blended[:, 3] > ENOUGH) & (facing > FLATTEST)
        white = colours * gain[:, 0, 0] + offset[:, 0, 0] >= WHITE
        weight = np.where(counts[:, None] & ~white, np.minimum(blended[:, 3:], 1), 0).astype(np.float64)
        shade(means, normals, without_turn(count), np.zeros((count, 3), np.float32), environment, centre, shown)
        value = np.where(shown[:, :3] > 1, 1 + (shown[:, :3] - 1) / OVER, shown[:, :3])
        seen = value * np.maximum(np.abs(value), np.sqrt(DARK))
        fall = np.float32(FALL) * np.clip(1 - facing, 0, 1) ** 4
        light = np.square(colours)
        seen -= fall[:, None] * light
        sums += weight * np.stack([np.ones_like(light), light, seen, seen * light, np.square(seen), np.square(light)])
    total = np.maximum(sums[0], 1e-6)
    changes = np.stack(
        [
            (sums[3] - sums[1] * sums[2] / total).sum(axis=1),
            np.maximum(sums[4] - np.square(sums[2]) / total, 0).sum(axis=1),
            np.maximum(sums[5] - np.square(sums[1]) / total, 0).sum(axis=1),
        ],
        1,
    )
    near = cKDTree(means).query(means, min(NEAR, count))[1].reshape(count, -1)
    same = (np.einsum("nkc,nc->nk", normals[near], normals) > SAME_SIDE).astype(np.float64)
    same[:, 0] = 1
    same /= same.sum(axis=1, keepdims=True)
    along, mirrored, light = _over(changes, near, same).T
    slopes = np.clip(along / np.maximum(mirrored, TINY), 0, STRONGEST)
    clear = np.square(np.maximum(along, 0)) / np.maximum(mirrored * light, TINY)
    about = np.stack([clear * slopes, clear], 1)
    for _ in range(ROUNDS):
        about = _over(about, near, same)
    there = about[:, 0] / np.maximum(about[:, 1], TINY) * np.square(np.minimum(about[:, 1] / GLOSSY, 1))
    believed = np.minimum(clear / CLEAR, 1)
    seen_strengths = believed * slopes + (1 - believed) * there
    strengths: Array = np.clip(seen_strengths, FAINTEST, STRONGEST).astype(np.float32)[:, None]
    return strengths


def _over(values: Float, near: NDArray[np.int64], weights: Float) -> Float:
    """Returns the [N, C] weighted means of values [N, C] over neighbours [N, k]; weights [N, k] sum to 1."""
    means: Float = np.einsum("nkc,nk->nc", values[near], weights)
    return means
