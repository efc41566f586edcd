"""Strengths of gloss from the pictures of frame 0: how far the colour of a surface follows what it would mirror.

Steps along gradients leave matte things half as glossy as they began, for nothing pulls hard there; they then show
highlights in views that no camera has had. Given normals and environment, the strength is the slope of a line.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scas4d_core.rasterize.cpu import CpuRasterizer
from scas4d_core.rasterize.shading import GLOSS, SAME_SIDE, camera_centre, without_turn
from scas4d_core.update.picture_loss import TrainingView

Array = NDArray[np.float32]
Float = NDArray[np.float64]

ENOUGH = 0.05
"""Pixels' worth of weight from which a camera's colour of a Gaussian counts."""
WHITE = 0.97
"""Colour from which a picture shows no more."""
FLATTEST = 0.2
"""Cosine to the camera below which footprints reach beyond the outline."""
NEAR = 64
"""Neighbours that share a slope: one alone is hardly in two highlights."""
DOUBT = 0.1
"""Of the median spread of what is mirrored, that speaks for the strength of the start: where nothing is to be mirrored,
nothing can be told."""
FAINTEST, STRONGEST = 0.02, 1.0
"""Bounds; what is fainter would have no normal."""


def strengths_seen(
    normals: Array,
    environment: Array,
    means: Array,
    factors: Array,
    opacities: Array,
    views: Sequence[TrainingView],
    rasterizer: CpuRasterizer,
) -> Array:
    """[N, 1] strengths of unit normals [N, 3] in an environment.

    Over the views, each Gaussian's light (its colour in the pictures, squared) is a line over what it would mirror; the
    slope is taken over neighbours on the same side of the surface.

    Args:
        means, factors, opacities: of the state. views: of it.
    """
    from scas4d_core.kernels.appearance.direction import DARK, FALL, OVER, shade

    count, black = len(means), np.zeros(4, np.float32)
    features, shown = np.zeros((count, 4), np.float32), np.zeros((count, 4), np.float32)
    sums = np.zeros((5, count, 3))  # of weights, light, mirrored, mirrored × light, mirrored²
    for view in views:
        rasterizer.forward(means, factors, opacities, features, view.camera, black)
        g_image, g_alpha = rasterizer.gradient_buffers()
        g_image[:], g_alpha[:] = 0, 0
        height, width = view.target.shape[1:]
        gain, offset = view.exposure[:3, :1, None], view.exposure[:3, 1:, None]
        g_image[:3, :height, :width] = (view.target[:3] - offset) / gain
        g_image[3, :height, :width] = 1
        found = rasterizer.backward(g_image, g_alpha, 3).features
        g_image[:] = 0
        colours = found[:, :3] / np.maximum(found[:, 3:], 1e-6)
        centre = camera_centre(view.camera)
        ahead = centre - means
        facing = np.einsum("nc,nc->n", ahead, normals) / np.maximum(np.linalg.norm(ahead, axis=1), 1e-9)
        counts = (found[:, 3] > ENOUGH) & (facing > FLATTEST)
        white = colours * gain[:, 0, 0] + offset[:, 0, 0] >= WHITE
        weight = np.where(counts[:, None] & ~white, np.minimum(found[:, 3:], 1), 0).astype(np.float64)
        shade(means, normals, without_turn(count), np.zeros((count, 3), np.float32), environment, centre, shown)
        value = np.where(shown[:, :3] > 1, 1 + (shown[:, :3] - 1) / OVER, shown[:, :3])
        seen = value * np.maximum(np.abs(value), np.sqrt(DARK))
        fall = np.float32(FALL) * np.clip(1 - facing, 0, 1) ** 4
        light = np.square(colours)
        seen -= fall[:, None] * light
        sums += weight * np.stack([np.ones_like(light), light, seen, seen * light, np.square(seen)])
    total = np.maximum(sums[0], 1e-6)
    both = np.stack(
        [
            (sums[3] - sums[1] * sums[2] / total).sum(axis=1),
            np.maximum(sums[4] - np.square(sums[2]) / total, 0).sum(axis=1),
        ],
        1,
    )
    near = cKDTree(means).query(means, min(NEAR, count))[1].reshape(count, -1)
    same = np.einsum("nkc,nc->nk", normals[near], normals) > SAME_SIDE
    along, spread = np.einsum("nkc,nk->nc", both[near], same).T
    doubt = DOUBT * float(np.median(spread))
    slopes = (along + doubt * GLOSS) / np.maximum(spread + doubt, 1e-12)
    strengths: Array = np.clip(slopes, FAINTEST, STRONGEST).astype(np.float32)[:, None]
    return strengths
