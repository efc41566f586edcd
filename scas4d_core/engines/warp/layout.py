"""The structures that the kernels of a picture share: cameras, the sizes of pictures and lists, the log.

Sizes of launches are constants of a CUDA graph, so buffers have the size of the largest picture; a kernel reads the
size of the picture at hand from its camera. All pictures have as many columns of tiles as the largest.
"""

from __future__ import annotations

from math import log

import warp as wp

from scas4d_core.engines.limits import Limits
from scas4d_core.engines.views import CameraArrays

wp.set_module_options({"enable_backward": False})

TILE = 16
"""Pixels of a tile's side."""
PIXELS = TILE * TILE
"""Pixels of a tile, and threads of a block that draws one."""
SEGMENT = 128
"""Entries of a segment: lists are drawn a segment at a time, side by side. 64 and 256 take 5 to 15 % longer."""

COLUMNS = 8
"""Numbers of a row of the log, which has a row for each rendering."""
IMAGE_LOSS, MASK_LOSS, SQUARES, SHIFT, PAIRS = 0, 1, 2, 3, 6
"""Columns of the log: weighted losses, sum of squared RGB differences, mean of the picture minus mean of the rendering
(three columns, RGB in 0…1, exposure included), entries of the tile lists."""


@wp.struct
class Camera:
    """A camera as kernels read it: world to camera, OpenCV axes; focal lengths and centre in pixels; picture size."""

    rotation: wp.mat33
    translation: wp.vec3
    fx: wp.float32
    fy: wp.float32
    cx: wp.float32
    cy: wp.float32
    width: wp.int32
    height: wp.int32


@wp.struct
class Raster:
    """Constants of a rasterizer.

    Attributes:
        count: Gaussians. columns, rows: pixels of the largest picture. tiles_x, tiles_y: its tiles.
        capacity: entries of all lists of one picture.
        alpha_floor, alpha_cap, stop, low_pass, near, margin: the fields of ``Limits``.
        log_floor: natural logarithm of ``alpha_floor``.
    """

    count: wp.int32
    columns: wp.int32
    rows: wp.int32
    tiles_x: wp.int32
    tiles_y: wp.int32
    capacity: wp.int32
    alpha_floor: wp.float32
    alpha_cap: wp.float32
    stop: wp.float32
    low_pass: wp.float32
    near: wp.float32
    margin: wp.float32
    log_floor: wp.float32


def camera_of(camera: CameraArrays) -> Camera:
    """The structure of a camera."""
    made = Camera()
    made.rotation = wp.mat33(*camera.pose[:, :3].ravel().tolist())
    made.translation = wp.vec3(*camera.pose[:, 3].tolist())
    made.fx, made.fy, made.cx, made.cy = camera.lens[:4].tolist()
    made.width, made.height = camera.width, camera.height
    return made


def raster_of(limits: Limits, count: int, columns: int, rows: int, capacity: int) -> Raster:
    """The structure of a rasterizer.

    Args:
        count: Gaussians. columns, rows: pixels of the largest picture. capacity: entries of all lists of one picture.
    """
    made = Raster()
    made.count, made.columns, made.rows, made.capacity = count, columns, rows, capacity
    made.tiles_x, made.tiles_y = -(-columns // TILE), -(-rows // TILE)
    made.alpha_floor, made.alpha_cap, made.stop = limits.alpha_floor, limits.alpha_cap, limits.transmittance_stop
    made.low_pass, made.near, made.margin = limits.low_pass, limits.near, limits.tangent_margin
    made.log_floor = log(limits.alpha_floor)
    return made
