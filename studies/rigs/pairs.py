"""Pairs per pixel: the number of Gaussians that the rasterizer blends into each pixel.

The number determines the time of an iteration. It is large where a state has stacks of large, nearly transparent
Gaussians. Gaussians behind the surface at which a pixel is complete do not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import log2

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.cpu.rasterizer import CpuRasterizer
from scas4d_core.engines.limits import Limits
from scas4d_core.engines.views import CameraArrays
from scas4d_core.gaussians import Gaussians
from scas4d_core.kernels.blend import BLOCK, BLOCK_X, BLOCK_Y, BLOCKS, HALF_LOG2_E
from scas4d_core.kernels.jit import HALF, ONE, TWO, kernel
from scas4d_core.kernels.projection import CONIC_A, CONIC_B, CONIC_C, LOG_OPACITY, MEAN_X, MEAN_Y, TILE

Array = NDArray[np.float32]


@kernel  # type: ignore[untyped-decorator]
def count_pairs(
    splats: Array,
    starts: NDArray[np.int64],
    items: NDArray[np.int32],
    covers: NDArray[np.uint64],
    tiles_x: int,
    limits: Array,
    counts: NDArray[np.int32],
) -> None:
    """Counts the Gaussians that are blended into each pixel, with the same rules as ``blend``.

    Args:
        splats, starts, items, covers: projected Gaussians and lists of the tiles; see ``blend``.
        tiles_x: number of tile columns.
        limits: rasterizer constants.
        counts: [rows, stride] int32 output, zero at first and padded to whole tiles.
    """
    faintest, cap, stop = log2(limits[0]), limits[1], limits[2]
    for tile in range(starts.shape[0] - 1):
        top, left = tile // tiles_x * TILE, tile % tiles_x * TILE
        light = np.ones((TILE, TILE), np.float32)
        for entry in range(starts[tile], starts[tile + 1]):
            splat = splats[items[entry]]
            for block in range(BLOCKS):
                if (covers[entry] >> np.uint64(block)) & np.uint64(1) == 0:
                    continue
                for y in range(int(BLOCK_Y[block]), int(BLOCK_Y[block]) + BLOCK):
                    for x in range(int(BLOCK_X[block]), int(BLOCK_X[block]) + BLOCK):
                        dx = np.float32(left + x) + HALF - splat[MEAN_X]
                        dy = np.float32(top + y) + HALF - splat[MEAN_Y]
                        form = splat[CONIC_A] * dx * dx + (TWO * splat[CONIC_B] * dx + splat[CONIC_C] * dy) * dy
                        power = splat[LOG_OPACITY] - HALF_LOG2_E * form
                        if power >= faintest and light[y, x] > 0:
                            after = light[y, x] * (ONE - min(np.float32(2.0**power), cap))
                            light[y, x] = after if after >= stop else 0  # the pixel is complete
                            counts[top + y, left + x] += after >= stop


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
        _, rows, stride = rasterizer.planes.shape
        counts = np.zeros((rows, stride), np.int32)
        count_pairs(rasterizer.splats, *rasterizer.tile_lists, stride // TILE, rasterizer.limits, counts)
        each.append(counts[: camera.height, : camera.width].ravel())
    return np.concatenate(each)
