"""Structures shared by the rendering kernels: cameras, rasterizer constants, and the columns of the log.

A CUDA graph fixes the launch dimensions, so buffers have the size of the largest image. Kernels read the actual image
size from the camera. All images use the tile stride of the largest image.
"""

from __future__ import annotations

from math import log

import warp as wp

from scas4d_core.engines.limits import Limits
from scas4d_core.engines.views import CameraArrays

wp.set_module_options({"enable_backward": False})

TILE = 16
"""Side length of a tile in pixels."""
PIXELS = TILE * TILE
"""Number of pixels per tile, which is also the number of threads in a block that renders a tile."""
SEGMENT = 128
"""Number of list entries per segment. Segments are blended in parallel. Values of 64 and 256 are 5 to 15% slower."""

COLUMNS = 8
"""Number of columns in the log, which has one row per rendering."""
IMAGE_LOSS, MASK_LOSS, SQUARES, SHIFT, PAIRS = 0, 1, 2, 3, 6
"""Columns of the log: weighted image and mask loss, sum of squared RGB differences, colour shift, and tile-list size.
The colour shift (three columns, RGB in [0, 1]) is the mean of the training image minus the mean of the rendering, with
exposure applied. The size is the number of tile-list entries or, if this exceeds the capacity, the required capacity
plus a margin."""


@wp.struct
class Camera:
    """A camera in kernel format: world-to-camera transform (OpenCV axes), and intrinsics and image size in pixels."""

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
    """Rasterizer constants.

    Attributes:
        count: number of Gaussians.
        columns, rows: size of the largest image, in pixels.
        tiles_x, tiles_y: size of the largest image, in tiles.
        capacity: maximum total number of entries in the tile lists of one image.
        alpha_floor, alpha_cap, stop, low_pass, near, margin: values of the corresponding ``Limits`` fields.
        log_floor: natural logarithm of ``alpha_floor``.
        detached: 1 if the label channel's gradient only affects the labels, not the geometry; otherwise 0.
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
    """Converts a camera to the kernel structure."""
    made = Camera()
    made.rotation = wp.mat33(*camera.pose[:, :3].ravel().tolist())
    made.translation = wp.vec3(*camera.pose[:, 3].tolist())
    made.fx, made.fy, made.cx, made.cy = camera.lens[:4].tolist()
    made.width, made.height = camera.width, camera.height
    return made


def raster_of(limits: Limits, count: int, columns: int, rows: int, capacity: int, detached: bool = False) -> Raster:
    """Returns the kernel structure with the rasterizer constants.

    Args:
        limits: rasterizer constants.
        count: number of Gaussians.
        columns, rows: size of the largest image, in pixels.
        capacity, detached: see ``Raster``.
    """
    made = Raster()
    made.count, made.columns, made.rows, made.capacity = count, columns, rows, capacity
    made.tiles_x, made.tiles_y = -(-columns // TILE), -(-rows // TILE)
    made.alpha_floor, made.alpha_cap, made.stop = limits.alpha_floor, limits.alpha_cap, limits.transmittance_stop
    made.low_pass, made.near, made.margin = limits.low_pass, limits.near, limits.tangent_margin
    made.log_floor, made.detached = log(limits.alpha_floor), int(detached)
    return made
