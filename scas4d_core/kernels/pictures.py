"""Kernels for 8-bit images: conversion to float planes, changed pixels, and differences along rows."""

from __future__ import annotations

import numpy as np

from scas4d_core.kernels.jit import kernel

CHANNELS = 3


@kernel
def fill_planes(image, planes):
    """Converts an image to float planes.

    Args:
        image: [H, W, 3] uint8 image.
        planes: [C, H, W] float32 output, of which the first three planes are filled with values in [0, 1].
    """
    scale = np.float32(1 / 255)
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            planes[0, row, column] = np.float32(image[row, column, 0]) * scale
            planes[1, row, column] = np.float32(image[row, column, 1]) * scale
            planes[2, row, column] = np.float32(image[row, column, 2]) * scale


@kernel
def mark_changes(before, now, most, reach, changed):
    """Marks the pixels in which two images differ, and their surroundings.

    Args:
        before, now: [H, W, 3] uint8 images.
        most: largest difference of a channel that does not count as a change.
        reach: number of pixels around a changed pixel that are marked in each direction.
        changed: [H, W] float32 output, 1 at marked pixels and 0 elsewhere.

    Returns:
        Whether any pixel differs.
    """
    height, width = changed.shape
    earlier, later = before.reshape(height, CHANNELS * width), now.reshape(height, CHANNELS * width)
    differs = False
    changed[:] = 0
    marks, wide = np.zeros(width + 2 * reach, np.uint8), np.zeros(width, np.uint8)
    for row in range(height):
        worst = np.int32(0)
        for k in range(CHANNELS * width):
            worst = max(worst, abs(np.int32(earlier[row, k]) - np.int32(later[row, k])))
        if worst <= most:
            continue
        differs = True
        marks[:], wide[:] = 0, 0
        for column in range(width):
            worst = np.int32(0)
            for k in range(CHANNELS * column, CHANNELS * column + CHANNELS):
                worst = max(worst, abs(np.int32(earlier[row, k]) - np.int32(later[row, k])))
            marks[column + reach] = worst > most
        for shift in range(2 * reach + 1):
            for column in range(width):
                wide[column] |= marks[column + shift]
        for near in range(max(0, row - reach), min(height, row + reach + 1)):
            for column in range(width):
                changed[near, column] = max(changed[near, column], np.float32(wide[column]))
    return differs


@kernel
def row_differences(image, every):
    """Returns the sums of the absolute first and second differences along every ``every``-th row.

    Args:
        image: [H, W, 3] uint8 image.
        every: stride of the rows.
    """
    first, second = np.int64(0), np.int64(0)
    height, width, _ = image.shape
    for row in range(0, height, every):
        for channel in range(CHANNELS):
            before = np.int32(0)
            for column in range(1, width):
                step = np.int32(image[row, column, channel]) - np.int32(image[row, column - 1, channel])
                first += abs(step)
                if column > 1:
                    second += abs(step - before)
                before = step
    return first, second
