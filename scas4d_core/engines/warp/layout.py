"""Structures shared by rendering kernels: cameras, sizes of pictures and lists, log.

Launch dimensions are constants of a CUDA graph, so buffers have the size of the largest picture. Kernels read the
actual picture size from the camera. All pictures use the tile stride of the largest one.
"""

from __future__ import annotations

from math import log

import warp as wp

from scas4d_core.engines.limits import Limits
from scas4d_core.engines.views import CameraArrays

wp.set_module_options({"enable_backward": False})

TILE = 16
"""Side of a tile in pixels."""
PIXELS = TILE * TILE
"""Pixels of a tile, and threads of a block that renders one."""
SEGMENT = 128
"""Entries per segment of a list; segments are blended in parallel. 64 and 256 are 5 to 15 % slower."""

COLUMNS = 8
"""Columns of the log, which has one row per rendering."""
IMAGE_LOSS, MASK_LOSS, SQUARES, SHIFT, PAIRS = 0, 1, 2, 3, 6
"""Columns of the log: weighted losses, sum of squared RGB differences, mean of the picture minus mean of the rendering
(three columns, RGB in 0…1, with exposure), and number of tile-list entries, or the capacity that would hold them with
room to spare, if they exceed it."""


@wp.struct
class Camera:
    """A camera in kernel format: world to camera, OpenCV axes; focal lengths and centre in pixels; picture size."""

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
        count: number of Gaussians. columns, rows: size of the largest picture in pixels. tiles_x, tiles_y: in tiles.
        capacity: maximum number of entries in all lists of one picture.
        alpha_floor, alpha_cap, stop, low_pass, near, margin: the fields of ``Limits``.
        log_floor: natural logarithm of ``alpha_floor``.
        detached: 1 if the gradient of the label only reaches the labels, not the shapes.
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
    detached: wp.int32


def camera_of(camera: CameraArrays) -> Camera:
    """Converts a camera to its kernel structure."""
    made = Camera()
    made.rotation = wp.mat33(*camera.pose[:, :3].ravel().tolist())
    made.translation = wp.vec3(*camera.pose[:, 3].tolist())
    made.fx, made.fy, made.cx, made.cy = camera.lens[:4].tolist()
    made.width, made.height = camera.width, camera.height
    return made


def raster_of(limits: Limits, count: int, columns: int, rows: int, capacity: int, detached: bool = False) -> Raster:
    """Returns the kernel structure of the rasterizer constants.

    Args:
        count: number of Gaussians. columns, rows: size of the largest picture in pixels.
        capacity, detached: see ``Raster``.
    """
    made = Raster()
    made.count, made.columns, made.rows, made.capacity = count, columns, rows, capacity
    made.tiles_x, made.tiles_y = -(-columns // TILE), -(-rows // TILE)
    made.alpha_floor, made.alpha_cap, made.stop = limits.alpha_floor, limits.alpha_cap, limits.transmittance_stop
    made.low_pass, made.near, made.margin = limits.low_pass, limits.near, limits.tangent_margin
    made.log_floor, made.detached = log(limits.alpha_floor), int(detached)
    return made
