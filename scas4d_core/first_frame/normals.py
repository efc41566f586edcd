"""Estimates the surface normals of a state from its rendered depth, for reflections (``engines.cpu.gloss``)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, gaussian_filter
from scipy.spatial import cKDTree

from scas4d_core.engines.renderer import Renderer
from scas4d_core.engines.views import TrainingView
from scas4d_core.gaussians import Gaussians

Array = NDArray[np.float32]

BLUR = 1.5
"""Standard deviation, in pixels, of the blur applied to depth before differentiation."""
STEEPEST = 0.2
"""Minimum cosine between the normal of a pixel and its viewing ray. Steeper normals are ignored."""
REACH, NEAR = 0.03, 64
"""Standard deviation of the weights (as a fraction of the extent) and number of the neighbours over
which normals are averaged."""
SKIN = 1 / 3
"""Exponent applied to opacities before depth is rendered. The fit represents a surface as a haze in
front of opaque Gaussians, and the haze is at the depth of the surface. On `gloss`, the depth rendered
without this exponent was 15 mm behind the surface. Median normal errors on vase and ring were 8 and 6
degrees without the exponent, and 4 and 4 degrees with it. With twice the neighbours at 1.5 times the
radius, the errors were 3 and 4 degrees."""
OPAQUE = 0.99
SOLID = 0.5
"""Minimum alpha of a pixel that shows a surface."""
TINY = 1e-9


def surface_normals(state: Gaussians, views: Sequence[TrainingView], renderer: Renderer) -> Array:
    """Returns the [N, 3] unit normals of the Gaussians, pointing outwards, towards the cameras.

    The normal of each pixel is computed from the gradient of the rendered depth. A Gaussian gets
    the mean of these normals, weighted by its blending weights. The normals are then averaged over
    neighbouring Gaussians.

    Args:
        state: Gaussians of the surface.
        views: training views. Depth is rendered from their cameras.
        renderer: renderer used to render depth.
    """
    means, count = state.means, len(state)
    haze = state.replace(opacities=np.minimum(state.opacities**SKIN, OPAQUE).astype(np.float32))
    features = np.zeros((count, 4), np.float32)
    reach = REACH * float(np.max(np.percentile(means, 99, axis=0) - np.percentile(means, 1, axis=0)))
    total, outwards = np.zeros((count, 4)), np.zeros((count, 3))
    for view in views:
        camera = view.camera
        picture = renderer.render(haze, camera, features, depth_channel=3)
        alpha = 1 - picture.transmittance
        solid = alpha > SOLID
        depth = np.where(solid, picture.features[3] / np.maximum(alpha, SOLID), 0).astype(np.float64)
        normals, weights = _pixel_normals(depth, solid, camera.lens, reach)
        planes = np.empty((4, *weights.shape), np.float32)
        planes[:3] = np.moveaxis(normals @ camera.pose[:, :3] * weights[:, :, None], -1, 0)
        planes[3] = weights
        seen = renderer.gather(haze, camera, planes)
        total += seen
        outwards += seen[:, 3:] * _unit(camera.centre - means)
    directions = np.where(total[:, 3:] > 1e-3, total[:, :3], outwards)
    directions = _unit(
        np.where(np.linalg.norm(directions, axis=1, keepdims=True) > TINY, directions, _unit(means - means.mean(0)))
    )
    weight = np.minimum(total[:, 3], 5) + 1e-3
    near = cKDTree(means).query(means, min(NEAR, count))
    distance, index = (np.asarray(array).reshape(count, -1) for array in near)
    share = np.exp(-0.5 * np.square(distance / reach)) * weight[index]
    share = share * (np.einsum("nkc,nc->nk", directions[index], directions) > 0)
    return _unit(np.einsum("nkc,nk->nc", directions[index], share)).astype(np.float32)


def _pixel_normals(
    depth: NDArray[Any], solid: NDArray[np.bool_], lens: Array, reach: float
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Returns the [H, W, 3] normals of the pixels in camera axes, and their [H, W] weights."""
    height, width = depth.shape
    smooth = gaussian_filter(depth, BLUR) / np.maximum(gaussian_filter(solid.astype(np.float64), BLUR), 1e-3)
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    points = np.stack([(u - lens[2]) / lens[0] * smooth, (v - lens[3]) / lens[1] * smooth, smooth], axis=-1)
    across, down = np.zeros_like(points), np.zeros_like(points)
    across[:, 1:-1] = points[:, 2:] - points[:, :-2]
    down[1:-1] = points[2:] - points[:-2]
    normals = _unit(np.cross(down, across))
    towards = -np.einsum("hwc,hwc->hw", normals, _unit(points))
    normals *= np.where(towards < 0, -1, 1)[:, :, None]
    inside = binary_erosion(solid, iterations=2) & (np.abs(smooth - depth) < reach)
    return normals, np.where(inside & (np.abs(towards) > STEEPEST), np.abs(towards), 0)


def _unit(vectors: NDArray[Any]) -> NDArray[Any]:
    unit: NDArray[Any] = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), TINY)
    return unit
