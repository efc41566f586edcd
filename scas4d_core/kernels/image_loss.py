"""The image loss 0.8 L1 + 0.2 (1 − SSIM) and its gradient, over planes [C, H, W]. Twin: ``losses.image_loss``.

SSIM is that of the 3DGS world: 11×11 Gaussian window, sigma 1.5, zero padding, C1 = 0.01², C2 = 0.03². The window is
separable; each pass is a loop along a row, which vectorizes.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from scas4d_core.kernels.jit import ONE, TWO, ZERO, inline, kernel, parallel_kernel

REACH = 5
"""Pixels of the window on either side of its centre."""

_taps = np.exp(-((np.arange(2 * REACH + 1) - REACH) ** 2) / (2 * 1.5**2))
_taps = (_taps / _taps.sum()).astype(np.float32)
T0, T1, T2, T3, T4, T5 = (np.float32(tap) for tap in _taps[: REACH + 1])

C1 = np.float32(0.01**2)
C2 = np.float32(0.03**2)
L1_SHARE = np.float32(0.8)
SSIM_SHARE = np.float32(0.2)


@kernel
def filter_row(source, out, width):
    """Filter a padded row [width + 10] along itself into ``out`` [width]."""
    for x in range(width):
        out[x] = (
            T0 * (source[x] + source[x + 10])
            + T1 * (source[x + 1] + source[x + 9])
            + T2 * (source[x + 2] + source[x + 8])
            + T3 * (source[x + 3] + source[x + 7])
            + T4 * (source[x + 4] + source[x + 6])
            + T5 * source[x + 5]
        )


@kernel
def filter_column(plane, row, out, width):
    """Filter across rows ``row`` … ``row + 10`` of a plane padded by 5 rows above and below into ``out`` [width]."""
    a, b, c, d, e, f = plane[row], plane[row + 1], plane[row + 2], plane[row + 3], plane[row + 4], plane[row + 5]
    g, h, i, j, k = plane[row + 6], plane[row + 7], plane[row + 8], plane[row + 9], plane[row + 10]
    for x in range(width):
        out[x] = (
            T0 * (a[x] + k[x])
            + T1 * (b[x] + j[x])
            + T2 * (c[x] + i[x])
            + T3 * (d[x] + h[x])
            + T4 * (e[x] + g[x])
            + T5 * f[x]
        )


@inline
def exposed(value, gain, offset):
    """What the camera records of a rendered value."""
    return gain * value + offset


@parallel_kernel
def target_moments(target, scratch, means, squares):
    """The window's mean of a target and of its square, once per frame and view.

    Args:
        target: [C, H, W]. scratch: [2, C, H + 10, W], its upper and lower 5 rows 0. means, squares: out [C, H, W].
    """
    channels, height, width = target.shape
    for task in prange(channels * height):
        channel, y = task // height, task % height
        row = np.zeros((2, width + 2 * REACH), np.float32)
        for x in range(width):
            value = target[channel, y, x]
            row[0, x + REACH] = value
            row[1, x + REACH] = value * value
        filter_row(row[0], scratch[0, channel, y + REACH], width)
        filter_row(row[1], scratch[1, channel, y + REACH], width)
    for task in prange(channels * height):
        channel, y = task // height, task % height
        filter_column(scratch[0, channel], y, means[channel, y], width)
        filter_column(scratch[1, channel], y, squares[channel, y], width)


@parallel_kernel
def image_loss(image, exposure, target, target_means, target_squares, weights, scratch, g_image, losses, g_exposure):
    """Loss of a rendered picture and its gradient.

    Args:
        image: [>= C, >= H, >= W] rendered planes. exposure: [C, 2] gain and offset of the camera per channel.
        target, target_means, target_squares: [C, H, W]. weights: [C] weight of each channel's mean.
        scratch: [6, C, H + 10, W], its upper and lower 5 rows 0: three windowed quantities and their gradients.
        g_image: out [>= C, >= H, >= W] dL/dimage. losses: out [C, H, 2], each row's share of the loss and its sum
            of squared differences.
        g_exposure: out [C, H, 2], each row's share of the gradient of gain and offset.
    """
    channels, height, width = target.shape
    for task in prange(channels * height):
        channel, y = task // height, task % height
        gain, offset = exposure[channel, 0], exposure[channel, 1]
        row = np.zeros((3, width + 2 * REACH), np.float32)
        for x in range(width):
            value = exposed(image[channel, y, x], gain, offset)
            row[0, x + REACH] = value
            row[1, x + REACH] = value * value
            row[2, x + REACH] = value * target[channel, y, x]
        for k in range(3):
            filter_row(row[k], scratch[k, channel, y + REACH], width)
    for task in prange(channels * height):
        channel, y = task // height, task % height
        share = weights[channel] / np.float32(height * width)
        gain, offset = exposure[channel, 0], exposure[channel, 1]
        mean = np.empty(width, np.float32)
        square = np.empty(width, np.float32)
        cross = np.empty(width, np.float32)
        filter_column(scratch[0, channel], y, mean, width)
        filter_column(scratch[1, channel], y, square, width)
        filter_column(scratch[2, channel], y, cross, width)
        loss = ZERO
        squared = ZERO
        row = np.zeros((3, width + 2 * REACH), np.float32)
        for x in range(width):
            m1, m2 = mean[x], target_means[channel, y, x]
            a1 = TWO * m1 * m2 + C1
            a2 = TWO * (cross[x] - m1 * m2) + C2
            b1 = m1 * m1 + m2 * m2 + C1
            b2 = square[x] - m1 * m1 + target_squares[channel, y, x] - m2 * m2 + C2
            inverse = ONE / (b1 * b2)
            ssim = a1 * a2 * inverse
            by_cross = TWO * a1 * inverse
            by_square = -ssim / b2
            by_mean = TWO * m2 * a2 * inverse - TWO * ssim * m1 / b1 - TWO * m1 * by_square - m2 * by_cross
            row[0, x + REACH] = by_mean
            row[1, x + REACH] = by_square
            row[2, x + REACH] = by_cross
            difference = exposed(image[channel, y, x], gain, offset) - target[channel, y, x]
            squared += difference * difference
            loss += L1_SHARE * abs(difference) + SSIM_SHARE * (ONE - ssim)
        losses[channel, y, 0] = loss * share
        losses[channel, y, 1] = squared
        for k in range(3):
            filter_row(row[k], scratch[3 + k, channel, y + REACH], width)
    for task in prange(channels * height):
        channel, y = task // height, task % height
        share = weights[channel] / np.float32(height * width)
        gain, offset = exposure[channel, 0], exposure[channel, 1]
        by_mean = np.empty(width, np.float32)
        by_square = np.empty(width, np.float32)
        by_cross = np.empty(width, np.float32)
        filter_column(scratch[3, channel], y, by_mean, width)
        filter_column(scratch[4, channel], y, by_square, width)
        filter_column(scratch[5, channel], y, by_cross, width)
        g_gain = ZERO
        g_offset = ZERO
        for x in range(width):
            rendered = image[channel, y, x]
            value = exposed(rendered, gain, offset)
            truth = target[channel, y, x]
            sign = ONE if value > truth else (-ONE if value < truth else ZERO)
            g = share * (L1_SHARE * sign - SSIM_SHARE * (by_mean[x] + TWO * value * by_square[x] + truth * by_cross[x]))
            g_gain += g * rendered
            g_offset += g
            g_image[channel, y, x] = g * gain
        g_exposure[channel, y, 0] = g_gain
        g_exposure[channel, y, 1] = g_offset
