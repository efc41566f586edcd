"""Supports of splats, and intersection tests between supports and tiles.

A splat consists of two rows of ``splats`` [2 N]: (mean x, mean y, conic a, conic b) and (conic c, ln opacity, reach,
depth). Its support is the set of points whose squared Mahalanobis distance from the mean is at most the reach. The
reach is slightly enlarged to prevent rounding from culling pixels that blending would cover. It is 0 for culled
Gaussians.
"""

from __future__ import annotations

import warp as wp

from scas4d_core.engines.warp.lanes import (
    ballot,
    bits_of,
    broadcast,
    fast_divide,
    lane,
    lane_count,
    load,
    lowest,
)
from scas4d_core.engines.warp.layout import TILE, Camera, Raster
from scas4d_core.guards import COVER_SLACK

wp.set_module_options({"enable_backward": False})

SLACK = wp.constant(wp.float32(COVER_SLACK))
HUGE = wp.constant(wp.float32(3.0e38))
FEW = wp.constant(4)  # boxes with up to this many tiles are processed by one lane, larger boxes by the whole warp
NONE = wp.constant(wp.uint32(0))
ONE = wp.constant(wp.uint32(1))


@wp.func
def least_form(
    a: wp.float32, b: wp.float32, c: wp.float32, left: wp.float32, right: wp.float32, top: wp.float32,
    bottom: wp.float32,
) -> wp.float32:  # fmt: skip
    """Returns the minimum of a x² + 2 b x y + c y² over a rectangle of offsets from the mean."""
    least = wp.float32(0.0)
    beside = left > 0.0 or right < 0.0
    above = top > 0.0 or bottom < 0.0
    if beside or above:
        least = HUGE
        if beside:
            x = wp.where(left > 0.0, left, right)
            y = wp.clamp(fast_divide(-b * x, c), top, bottom)
            least = a * x * x + 2.0 * b * x * y + c * y * y
        if above:
            y2 = wp.where(top > 0.0, top, bottom)
            x2 = wp.clamp(fast_divide(-b * y2, a), left, right)
            least = wp.min(least, a * x2 * x2 + 2.0 * b * x2 * y2 + c * y2 * y2)
    return least


@wp.func
def tile_form(camera: Camera, first: wp.vec4, second: wp.vec4, tile_x: wp.int32, tile_y: wp.int32) -> wp.float32:
    """Returns the minimum of a splat's quadratic form over the pixel centres of a tile."""
    left = wp.float32(tile_x * TILE) + 0.5 - first[0]
    top = wp.float32(tile_y * TILE) + 0.5 - first[1]
    across = wp.float32(wp.min(TILE, camera.width - tile_x * TILE) - 1)
    down = wp.float32(wp.min(TILE, camera.height - tile_y * TILE) - 1)
    return least_form(first[2], first[3], second[0], left, left + across, top, top + down)


@wp.func
def enter_list(
    raster: Raster, camera: Camera, row: wp.int32, first: wp.vec4, second: wp.vec4, tile_x: wp.int32,
    tile_y: wp.int32, starts: wp.array[wp.int32], tile_counts: wp.array[wp.int32], keys: wp.array[wp.uint64],
    filling: wp.int32,
) -> None:  # fmt: skip
    """Adds a splat to a tile's list if its support intersects the tile; see ``enter_lists``."""
    if tile_form(camera, first, second, tile_x, tile_y) <= second[2]:
        tile = tile_y * raster.tiles_x + tile_x
        place = wp.atomic_add(tile_counts, tile, 1)
        if filling == 1:
            keys[starts[tile] + place] = (wp.uint64(bits_of(second[3])) << wp.uint64(32)) | wp.uint64(row)


@wp.func
def enter_lists(
    raster: Raster, camera: Camera, i: wp.int32, drawn: wp.int32, splats: wp.array[wp.vec4],
    boxes: wp.array[wp.vec4i], starts: wp.array[wp.int32], tile_counts: wp.array[wp.int32],
    keys: wp.array[wp.uint64], filling: wp.int32,
) -> None:  # fmt: skip
    """Adds the splats of a warp to the lists of all tiles that they intersect, or only counts the entries.

    Args:
        raster: rasterizer constants.
        camera: camera of the image.
        i: index of the lane's splat.
        drawn: 1 if this splat has a bounding box, otherwise 0.
        splats, boxes: outputs of ``projection.project``.
        starts: first entry of each list.
        tile_counts: [tiles] number of entries in each list, accumulated.
        keys: output, depth and row of each entry.
        filling: 1 to add the entries, or 0 to only count them, in which case ``starts`` and ``keys`` are not used.
    """
    area = wp.int32(0)
    if drawn == 1:
        box = boxes[i]
        area = (box[2] - box[0]) * (box[3] - box[1])
        if area <= FEW:
            first = load(splats, 2 * i)
            second = load(splats, 2 * i + 1)
            for tile_y in range(box[1], box[3]):
                for tile_x in range(box[0], box[2]):
                    enter_list(
                        raster, camera, i, first, second, tile_x, tile_y, starts, tile_counts, keys, filling
                    )  # fmt: skip
    large = ballot(wp.where(area > FEW, 1, 0))
    while large != NONE:
        row = broadcast(i, lowest(large))
        large = large & (large - ONE)
        whole = boxes[row]
        across = whole[2] - whole[0]
        shared = load(splats, 2 * row)
        shape = load(splats, 2 * row + 1)
        for k in range(lane(), across * (whole[3] - whole[1]), lane_count()):
            y = k // across
            enter_list(
                raster, camera, row, shared, shape, whole[0] + k - y * across, whole[1] + y, starts, tile_counts, keys,
                filling,
            )  # fmt: skip
