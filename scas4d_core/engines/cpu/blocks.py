"""Conversions between bitmasks and grids of an image's 4×4-pixel blocks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.renderer import BLOCK
from scas4d_core.engines.views import CameraArrays
from scas4d_core.kernels.projection import TILE


def tile_grid(camera: CameraArrays) -> tuple[int, int]:
    """Returns the number of tile columns and tile rows of a camera's image."""
    return -(-camera.width // TILE), -(-camera.height // TILE)


def as_grid(blocks: NDArray[np.uint64], camera: CameraArrays) -> NDArray[np.bool_]:
    """Converts per-tile bitmasks, with bit 8 x + y for block (x, y), to a [rows, columns] grid of blocks."""
    tiles_x, tiles_y = tile_grid(camera)
    side = TILE // BLOCK
    bits = np.unpackbits(blocks.astype("<u8").view(np.uint8).reshape(-1, 8), axis=1, bitorder="little")
    grid = bits.reshape(tiles_y, tiles_x, side, side).transpose(0, 3, 1, 2)
    return grid.reshape(tiles_y * side, tiles_x * side).astype(bool)


def pixels_of(blocks: NDArray[np.uint64], camera: CameraArrays) -> NDArray[np.bool_]:
    """Returns the mask [H, W] of all pixels in the given blocks."""
    grid = as_grid(blocks, camera)
    return np.repeat(np.repeat(grid, BLOCK, 0), BLOCK, 1)[: camera.height, : camera.width]


def as_blocks(grid: NDArray[np.bool_], camera: CameraArrays) -> NDArray[np.uint64]:
    """Converts a grid of blocks to per-tile bitmasks [tiles]."""
    tiles_x, tiles_y = tile_grid(camera)
    side = TILE // BLOCK
    bits = grid.reshape(tiles_y, side, tiles_x, side).transpose(0, 2, 3, 1).reshape(-1, side * side)
    packed = np.packbits(bits, axis=1, bitorder="little")
    return np.ascontiguousarray(packed).view("<u8").reshape(-1).astype(np.uint64)


def widened(marks: NDArray[np.uint64], camera: CameraArrays, by: int) -> NDArray[np.uint64]:
    """Dilates the marked blocks by ``by`` blocks in every direction."""
    grid = as_grid(marks, camera)
    for _ in range(by):
        wider = grid.copy()
        wider[1:] |= grid[:-1]
        wider[:-1] |= grid[1:]
        grid = wider.copy()
        grid[:, 1:] |= wider[:, :-1]
        grid[:, :-1] |= wider[:, 1:]
    return as_blocks(grid, camera)
