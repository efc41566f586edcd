"""Image loss of a rectangular part of an image in which only some blocks were rendered.

All other blocks show a base image. One parallel region composes the part, compares it, and copies the gradient back to
the rendered blocks.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from scas4d_core.kernels.image_loss import REACH, band_of, loss_of_band
from scas4d_core.kernels.jit import ZERO, inline, kernel, parallel_kernel
from scas4d_core.kernels.projection import TILE
from scas4d_core.kernels.tiles import BLOCK


@inline
def is_marked(blocks, tiles_x, y, x):
    """Returns whether the block that contains a pixel is marked."""
    number = x % TILE // BLOCK * (TILE // BLOCK) + y % TILE // BLOCK
    return (blocks[y // TILE * tiles_x + x // TILE] >> np.uint64(number)) & np.uint64(1) != 0


@kernel
def compose_row(channel, y, planes, base, blocks, tiles_x, box, part):
    """Composes row y of the image, inside a box, from rendered blocks and a base image; see ``box_loss``.

    Each pixel is written once, because another band may be reading the same row.

    Returns:
        Sum of the differences from the base image.
    """
    top, _, left, right = box
    shift = 0.0
    for x in range(left // BLOCK * BLOCK, right, BLOCK):
        begin, end = max(x, left), min(x + BLOCK, right)
        if is_marked(blocks, tiles_x, y, x):
            for k in range(begin, end):
                shift += np.float64(planes[channel, y, k] - base[channel, y, k])
                part[channel, y - top, k - left] = planes[channel, y, k]
        else:
            for k in range(begin, end):
                part[channel, y - top, k - left] = base[channel, y, k]
    return shift


@kernel
def write_row(channel, y, part, blocks, tiles_x, box, planes):
    """Copies the given blocks of row y from a box back to an image. All other blocks remain unchanged."""
    top, _, left, right = box
    for x in range(left // BLOCK * BLOCK, right, BLOCK):
        if is_marked(blocks, tiles_x, y, x):
            for k in range(max(x, left), min(x + BLOCK, right)):
                planes[channel, y, k] = part[channel, y - top, k - left]


@kernel
def loss_of_rows(
    channel, begin, end, planes, base, blocks, tiles_x, box, part, g_part, g_image, exposure, target, target_means,
    target_squares, weights, pixels, scratch, wanted, losses, g_exposure, spans, row_shifts,
):  # fmt: skip
    """Processes the rows [begin, end) of a channel of the box; see ``box_loss``."""
    top, height = box[0], box[1] - box[0]
    for y in range(max(0, begin - 4 * REACH), min(height, end + 4 * REACH)):
        row_shifts[channel, y] = compose_row(channel, top + y, planes, base, blocks, tiles_x, box, part)
    if channel < target.shape[0]:
        loss_of_band(
            channel, begin, end, part, exposure, target, target_means, target_squares, weights, pixels, scratch,
            wanted, g_part, losses, g_exposure, spans,
        )  # fmt: skip
    else:
        g_part[channel, begin:end] = ZERO
    for y in range(begin, end):
        write_row(channel, top + y, g_part, blocks, tiles_x, box, g_image)


@parallel_kernel
def box_loss(
    bands, planes, base, blocks, tiles_x, box, part, g_part, g_image, exposure, target, target_means, target_squares,
    weights, pixels, scratch, wanted, losses, g_exposure, shifts,
):  # fmt: skip
    """Composes a box of an image from rendered blocks and a base image, and computes its loss and gradient.

    Args:
        bands: number of bands per channel, from ``image_loss.bands_of``. The result does not depend on it.
        planes: [C, rows, stride] float32 rendering, which is used in the given blocks.
        base: [C, H, W] float32 base image, which is used everywhere else.
        blocks: [tiles] uint64 mask of the rendered blocks.
        tiles_x: number of tile columns.
        box: first row, last row + 1, first column, last column + 1.
        part: [C, h, w] float32 output, the image inside the box.
        g_part: [C, h, w] float32 output, gradient inside the box; 0 in channels without target.
        g_image: [C, rows, stride] float32 output, gradient, written only in the given blocks.
        exposure, target, target_means, target_squares, weights, pixels, scratch, wanted, losses, g_exposure: see
            ``image_loss.image_loss``, for the image inside the box. The target may have fewer channels.
        shifts: [C] float64 output, difference between ``part`` and the base image, summed over the box.
    """
    channels, height = base.shape[0], box[1] - box[0]
    spans, row_shifts = np.empty((channels, height, 4), np.int64), np.empty((channels, height), np.float64)
    for task in prange(channels * bands):
        channel, begin, end = band_of(np.int64(task), bands, height)
        loss_of_rows(
            channel, begin, end, planes, base, blocks, tiles_x, box, part, g_part, g_image, exposure, target,
            target_means, target_squares, weights, pixels, scratch, wanted, losses, g_exposure, spans, row_shifts,
        )  # fmt: skip
    for channel in range(channels):
        shifts[channel] = 0.0
        for y in range(height):
            shifts[channel] += row_shifts[channel, y]
