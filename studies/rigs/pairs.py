"""Pairs per pixel: the number of Gaussians that the rasterizer blends into each pixel.

The number determines the time of an iteration. It is large where a state has stacks of large, nearly transparent
Gaussians. Gaussians behind the surface at which a pixel is complete do not count.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.cpu.rasterizer import CpuRasterizer
from scas4d_core.engines.limits import Limits
from scas4d_core.engines.views import CameraArrays
from scas4d_core.gaussians import Gaussians
from studies.kernels.pairs import blended_pairs


def pairs_per_pixel(state: Gaussians, cameras: Sequence[CameraArrays], limits: Limits) -> NDArray[np.int32]:
    """Returns the number of Gaussians blended into each pixel, [pixels of all cameras].

    Args:
        state: Gaussians to render.
        cameras: cameras in the internal world.
        limits: rasterizer constants.

    >>> from scas4d_core.cameras import Camera
    >>> from scas4d_core.engines.limits import DEFAULT
    >>> state = Gaussians.of_points([[0, 0, 2], [0, 0, 3]], radius=0.1, colours=[1, 0, 0])
    >>> camera = Camera("front", [[100, 0, 16], [0, 100, 16], [0, 0, 1]], np.eye(4), 32, 32)
    >>> pairs = pairs_per_pixel(state, [CameraArrays.of(camera)], DEFAULT).reshape(32, 32)
    >>> int(pairs[16, 16]), int(pairs[0, 0])
    (2, 0)
    """
    rasterizer, each = CpuRasterizer(limits), []
    features, background = state.features(state.colours), np.zeros(4, np.float32)
    for camera in cameras:
        rasterizer.forward(state.means, state.factors, state.opacities, features, camera, background)
        pairs, _, _ = blended_pairs(rasterizer.splats, rasterizer.counts, camera.width, camera.height, limits)
        each.append(pairs.ravel())
    return np.concatenate(each)
