"""Kernels for 8-bit images: conversion to float planes, and changed pixels."""

from __future__ import annotations

import numpy as np

from scas4d_core.kernels.jit import kernel

CHANNELS = 3
VALUES = np.arange(256, dtype=np.float32) * np.float32(1 / 255)
"""[256] values in [0, 1] of the 8-bit levels. A table is faster than converting and scaling each pixel."""


@kernel
def fill_planes(image, planes):
    """Converts an image to float planes.

    Args:
        image: [H, W, 3] uint8 image.
        planes: [C, H, W] float32 output, of which the first three planes are filled with values in [0, 1].
    """
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            planes[0, row, column] = VALUES[image[row, column, 0]]
            planes[1, row, column] = VALUES[image[row, column, 1]]
            planes[2, row, column] = VALUES[image[row, column, 2]]


@kernel
def mark_changes(before, now, most, reach, changed):
    """Marks the pixels in which two images differ, and their surroundings.

    Args:
        before, now: [H, W, 3] uint8 images.
        most: largest difference of a channel that does not count as a change, at most 255.
        reach: number of pixels around a changed pixel that are marked in each direction.
        changed: [H, W] float32 output, 1 at marked pixels and 0 elsewhere.

    Returns:
        Whether any pixel differs.
    """
    height, width = changed.shape
    earlier, later = before.reshape(height, CHANNELS * width), now.reshape(height, CHANNELS * width)
    differs, limit = False, np.uint8(most)
    changed[:] = 0
    gaps = np.empty(CHANNELS * width, np.uint8)
    marks, wide = np.zeros(width + 2 * reach, np.uint8), np.zeros(width, np.uint8)
    for row in range(height):
        worst = np.uint8(0)
        for k in range(CHANNELS * width):  # in 8 bits, so that the loop vectorizes
            one, other = earlier[row, k], later[row, k]
            gaps[k] = max(one, other) - min(one, other)
            worst = max(worst, gaps[k])
        if worst <= limit:
            continue
        differs = True
        wide[:] = 0
        for column in range(width):
            k = CHANNELS * column
            marks[column + reach] = (gaps[k] > limit) | (gaps[k + 1] > limit) | (gaps[k + 2] > limit)
        for shift in range(2 * reach + 1):
            for column in range(width):
                wide[column] |= marks[column + shift]
        for near in range(max(0, row - reach), min(height, row + reach + 1)):
            for column in range(width):
                changed[near, column] = max(changed[near, column], np.float32(wide[column]))
    return differs
