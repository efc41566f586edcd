"""Image loss 0.8 L1 + 0.2 (1 − SSIM) of images [C, H, W], and its gradient.

SSIM is defined as in 3D Gaussian Splatting, with an 11×11 Gaussian window, sigma 1.5, zero padding,
C1 = 0.01² and C2 = 0.03². Because the window is separable, images are filtered in two passes, along
rows and across rows. Both passes process sixteen pixels at a time.

In many images, large areas are black in both target and rendering. A window that is 0 in both
images has an SSIM of 1 and no gradient, so only columns near pixels that are not black are
computed. If only part of the image is requested (``near``), groups of sixteen columns far from this
part are skipped too. The reference implementation is ``engines.torch.losses.image_loss``.
"""

from __future__ import annotations

import numpy as np
from numba import prange
from numpy.typing import NDArray

from scas4d_core.guards import SSIM_C1, SSIM_C2
from scas4d_core.kernels import lanes
from scas4d_core.kernels.jit import ONE, TWO, ZERO, inline, kernel, parallel_kernel, threads

REACH = 5
"""Radius of the window in pixels."""

_taps = np.exp(-((np.arange(2 * REACH + 1) - REACH) ** 2) / (2 * 1.5**2))
_taps = (_taps / _taps.sum()).astype(np.float32)
T0, T1, T2, T3, T4, T5 = (np.float32(tap) for tap in _taps[: REACH + 1])

C1 = np.float32(SSIM_C1)
C2 = np.float32(SSIM_C2)
L1_SHARE = np.float32(0.8)
SSIM_SHARE = np.float32(0.2)


PAD = lanes.COUNT
"""Number of zeros with which a row is padded on either side before the row is filtered."""


BAND = 32
"""Minimum number of image rows per task. A task also computes rows of its neighbours that its own rows depend on."""

WINDOWS, LOSS, SPREAD, GRADIENT = np.uint8(1), np.uint8(2), np.uint8(4), np.uint8(8)
"""Flags that select the quantities to compute for sixteen columns of a row: windowed quantities, loss, loss gradients
filtered along the row, and finally these gradients filtered across rows, which yields the image gradient."""
EVERYWHERE = np.full((1, 1), WINDOWS | LOSS | SPREAD | GRADIENT)
LOSSES = WINDOWS | LOSS
"""Flags required to compute the loss without gradients."""


def near(shown: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Returns the flags [H, columns] for the gradient of pixels and for all affected losses.

    A column of the result covers sixteen columns of the image.

    Args:
        shown: [H, W] mask of the pixels.

    >>> shown = np.zeros((20, 48), bool)
    >>> shown[10, 20] = True
    >>> near(shown)[[0, 5, 10]].tolist()  # the pixel is less than a window from the first sixteen columns
    [[1, 1, 0], [7, 7, 0], [7, 15, 0]]
    """
    height, width = shown.shape
    columns = stride(width) // lanes.COUNT
    bytes_of_rows = np.zeros((height, (columns + 2) * lanes.COUNT), np.uint8)  # padded by 16 columns on either side
    bytes_of_rows[:, lanes.COUNT : lanes.COUNT + width] = shown
    eights = bytes_of_rows.view("<u8").reshape(height, columns + 2, 2)
    inside = (eights[:, 1:-1, 0] | eights[:, 1:-1, 1]) != 0
    beside = (eights[:, :-2, 1] >> np.uint64(8 * (8 - REACH))) | (eights[:, 2:, 0] << np.uint64(8 * (8 - REACH)))
    sums = np.zeros((height + 1, columns), np.int32)
    np.cumsum(inside | (beside != 0), axis=0, out=sums[1:])
    rows, result = np.arange(height), np.where(inside, GRADIENT, np.uint8(0))
    for what, up in ((WINDOWS, 2 * REACH), (LOSS | SPREAD, REACH)):
        some = sums[np.minimum(rows + 1 + up, height)] > sums[np.maximum(rows - up, 0)]
        result |= np.where(some, what, np.uint8(0))
    return result


def bands_of(channels: int, height: int) -> int:
    """Returns the number of bands into which the rows of each channel are divided, enough for all threads."""
    return max(1, min(-(-threads() // channels), height // BAND))


def stride(width: int) -> int:
    """Returns the row length of scratch buffers: the width, rounded up to a multiple of sixteen."""
    return -(-width // lanes.COUNT) * lanes.COUNT


@inline
def filter_along_row(row, place):
    """Filters a row along its columns, and returns sixteen values from flat index ``place``."""
    return (
        T0 * (lanes.load(row, place - 5) + lanes.load(row, place + 5))
        + T1 * (lanes.load(row, place - 4) + lanes.load(row, place + 4))
        + T2 * (lanes.load(row, place - 3) + lanes.load(row, place + 3))
        + T3 * (lanes.load(row, place - 2) + lanes.load(row, place + 2))
        + T4 * (lanes.load(row, place - 1) + lanes.load(row, place + 1))
        + T5 * lanes.load(row, place)
    )


@inline
def filter_across_rows(scratch, place, pitch):
    """Filters across eleven rows, and returns sixteen values.

    The first row starts at flat index ``place``, and consecutive rows are ``pitch`` apart.
    """
    return (
        T0 * (lanes.load(scratch, place) + lanes.load(scratch, place + 10 * pitch))
        + T1 * (lanes.load(scratch, place + pitch) + lanes.load(scratch, place + 9 * pitch))
        + T2 * (lanes.load(scratch, place + 2 * pitch) + lanes.load(scratch, place + 8 * pitch))
        + T3 * (lanes.load(scratch, place + 3 * pitch) + lanes.load(scratch, place + 7 * pitch))
        + T4 * (lanes.load(scratch, place + 4 * pitch) + lanes.load(scratch, place + 6 * pitch))
        + T5 * lanes.load(scratch, place + 5 * pitch)
    )


@inline
def apply_exposure(value, gain, offset):
    """Returns the pixel value that a camera records: the rendered value times gain, plus offset."""
    return gain * value + offset


@inline
def is_needed(what, wanted, y, x):
    """Returns whether ``what`` is requested for the sixteen columns that start at x."""
    return (wanted[0, 0] if wanted.shape[0] == 1 else wanted[y, x // lanes.COUNT]) & what != 0


@kernel
def filter_rows(rows, quantities, scratch, kind, channel, y, span, cleared, what, wanted):
    """Filters one padded row per quantity, and stores the results in the scratch buffer.

    Args:
        rows: [quantities or more, pitch + 2 PAD] rows to filter.
        quantities: number of rows to filter.
        scratch: output buffer; see ``image_loss``.
        kind, channel, y: index of the first output row in ``scratch``.
        span: range of columns to filter, multiples of ``Lanes``.
        cleared: range of columns to set to 0 outside ``span``.
        what, wanted: arguments of ``is_needed``. Columns in ``span`` that are not requested remain
            unchanged.
    """
    _, channels, height, pitch = scratch.shape
    for k in range(quantities):
        place = (((kind + k) * channels + channel) * height + y + REACH) * pitch
        for x in range(cleared[0], min(span[0], cleared[1]), lanes.COUNT):
            lanes.store(scratch, place + x, lanes.fill(ZERO))
        for x in range(span[0], span[1], lanes.COUNT):
            if is_needed(what, wanted, y, x):
                lanes.store(scratch, place + x, filter_along_row(rows, k * (pitch + 2 * PAD) + PAD + x))
        for x in range(max(span[1], cleared[0]), cleared[1], lanes.COUNT):
            lanes.store(scratch, place + x, lanes.fill(ZERO))


@inline
def start_of(planes, channel, y):
    """Returns the flat index at which a row starts."""
    return (channel * planes.shape[1] + y) * planes.shape[2]


@kernel
def span_of(image, gain, offset, target, channel, y, pitch, spans):
    """Finds the column ranges of a row near pixels that are not black in both images.

    Args:
        spans: [4] output: column range (first, last + 1) of the centres of windows that contain
            such pixels, followed by the range of all pixels in these windows. Both ranges are
            rounded to multiples of sixteen. If there are no such pixels, both ranges are (pitch,
            0).
    """
    width = target.shape[2]
    here, there = start_of(image, channel, y), start_of(target, channel, y)
    first, last = pitch, 0
    for x in range(0, width, lanes.COUNT):
        value = apply_exposure(lanes.load_first(image, here + x, width - x), gain, offset)
        truth = lanes.load_first(target, there + x, width - x)
        if lanes.any_of(value != ZERO) or lanes.any_of(truth != ZERO):
            first, last = min(first, x), min(x + lanes.COUNT, width)
    if last > 0 and offset == ZERO:
        while gain * image[channel, y, first] == ZERO and target[channel, y, first] == ZERO:
            first += 1
        while gain * image[channel, y, last - 1] == ZERO and target[channel, y, last - 1] == ZERO:
            last -= 1
    for k in range(2):
        reach = (k + 1) * REACH if last > 0 else 0
        spans[2 * k] = max(first - reach, 0) // lanes.COUNT * lanes.COUNT
        spans[2 * k + 1] = min((last + reach + lanes.COUNT - 1) // lanes.COUNT * lanes.COUNT, pitch)


@inline
def union_of_spans(spans, which, y, reach):
    """Returns the smallest column range that contains the spans of all rows within ``reach`` of row y."""
    first, last = spans[y, which], spans[y, which + 1]
    for other in range(max(0, y - reach), min(spans.shape[0], y + reach + 1)):
        first = min(first, spans[other, which])
        last = max(last, spans[other, which + 1])
    return first, last


@parallel_kernel
def target_moments(target, scratch, means, squares):
    """Computes the windowed means of a target image and of its square, once per frame and view.

    Args:
        target: [C, H, W] target image.
        scratch: [2 or more, C, H + 10, stride(W)] scratch buffer whose first and last 5 rows are 0.
        means, squares: [C, H, W] outputs.
    """
    channels, height, width = target.shape
    pitch = scratch.shape[3]
    for task in prange(channels * height):
        channel, y = task // height, task % height
        rows = np.zeros((2, pitch + 2 * PAD), np.float32)
        for x in range(width):
            value = target[channel, y, x]
            rows[0, PAD + x] = value
            rows[1, PAD + x] = value * value
        filter_rows(rows, 2, scratch, 0, channel, y, (0, pitch), (0, 0), WINDOWS, EVERYWHERE)
    for task in prange(channels * height):
        channel, y = task // height, task % height
        row = np.empty((2, pitch), np.float32)
        for k in range(2):
            place = ((k * channels + channel) * (height + 2 * REACH) + y) * pitch
            for x in range(0, pitch, lanes.COUNT):
                lanes.store(row, k * pitch + x, filter_across_rows(scratch, place + x, pitch))
        for x in range(width):
            means[channel, y, x] = row[0, x]
            squares[channel, y, x] = row[1, x]


@kernel
def windows_of_row(image, exposure, target, scratch, spans, rows, channel, y, wanted):
    """Runs the first pass of ``image_loss`` on a row.

    The pass filters the image, its square, and its product with the target along the row.
    """
    width, pitch = target.shape[2], scratch.shape[3]
    gain, offset = exposure[channel, 0], exposure[channel, 1]
    here, there = start_of(image, channel, y), start_of(target, channel, y)
    clear(rows)
    first, last = spans[channel, y, 0], spans[channel, y, 1]
    for x in range(first, last, lanes.COUNT):
        value = lanes.only_first(apply_exposure(lanes.load_first(image, here + x, width - x), gain, offset), width - x)
        lanes.store(rows, PAD + x, value)
        lanes.store(rows, pitch + 3 * PAD + x, value * value)
        lanes.store(rows, 2 * pitch + 5 * PAD + x, value * lanes.load_first(target, there + x, width - x))
    cleared = union_of_spans(spans[channel], 0, y, 2 * REACH)
    filter_rows(rows, 3, scratch, 0, channel, y, (first, last), cleared, WINDOWS, wanted)


@kernel
def clear(rows):
    """Sets padded rows to 0."""
    for x in range(0, rows.size, lanes.COUNT):
        lanes.store(rows, x, lanes.fill(ZERO))


@kernel
def loss_of_row(
    image, exposure, target, target_means, target_squares, weights, pixels, scratch, spans, rows, losses, channel, y,
    wanted,
):  # fmt: skip
    """Runs the second pass of ``image_loss`` on a row.

    The pass computes the loss of the row, and the loss gradients filtered along the row.
    """
    channels, height, width = target.shape
    pitch = scratch.shape[3]
    gain, offset = exposure[channel, 0], exposure[channel, 1]
    first, last = union_of_spans(spans[channel], 0, y, REACH)
    here, there = start_of(image, channel, y), start_of(target, channel, y)
    clear(rows)
    loss = squared = lanes.fill(ZERO)
    place = (channel * (height + 2 * REACH) + y) * pitch
    kind = channels * (height + 2 * REACH) * pitch
    for x in range(first, last, lanes.COUNT):
        if not is_needed(LOSS, wanted, y, x):
            continue
        m1 = filter_across_rows(scratch, place + x, pitch)
        square = filter_across_rows(scratch, place + kind + x, pitch)
        cross = filter_across_rows(scratch, place + 2 * kind + x, pitch)
        m2 = lanes.load_first(target_means, there + x, width - x)
        a1 = TWO * m1 * m2 + C1
        a2 = TWO * (cross - m1 * m2) + C2
        b1 = m1 * m1 + m2 * m2 + C1
        b2 = square - m1 * m1 + lanes.load_first(target_squares, there + x, width - x) - m2 * m2 + C2
        inverse = lanes.fill(ONE) / (b1 * b2)
        ssim = a1 * a2 * inverse
        if is_needed(SPREAD, wanted, y, x):
            by_cross = TWO * a1 * inverse
            by_square = -ssim * b1 * inverse
            by_mean = TWO * (m2 * a2 * inverse - ssim * m1 * b2 * inverse - m1 * by_square) - m2 * by_cross
            lanes.store(rows, PAD + x, lanes.only_first(by_mean, width - x))
            lanes.store(rows, pitch + 3 * PAD + x, lanes.only_first(by_square, width - x))
            lanes.store(rows, 2 * pitch + 5 * PAD + x, lanes.only_first(by_cross, width - x))
        difference = apply_exposure(lanes.load_first(image, here + x, width - x), gain, offset)
        difference = lanes.only_first(difference - lanes.load_first(target, there + x, width - x), width - x)
        squared += difference * difference
        loss += L1_SHARE * lanes.magnitude(difference) + SSIM_SHARE * lanes.only_first(ONE - ssim, width - x)
    losses[channel, y, 0] = lanes.sum_of(loss) * (weights[channel] / np.float32(pixels))
    losses[channel, y, 1] = lanes.sum_of(squared)
    filtered, cleared = union_of_spans(spans[channel], 2, y, REACH), union_of_spans(spans[channel], 2, y, 3 * REACH)
    filter_rows(rows, 3, scratch, 3, channel, y, filtered, cleared, SPREAD, wanted)


@kernel
def gradient_of_row(image, exposure, target, weights, pixels, scratch, spans, g_image, g_exposure, channel, y, wanted):
    """Runs the third pass of ``image_loss`` on a row, which computes the gradient of the row."""
    channels, height, width = target.shape
    pitch = scratch.shape[3]
    share = weights[channel] / np.float32(pixels)
    gain, offset = exposure[channel, 0], exposure[channel, 1]
    first, last = union_of_spans(spans[channel], 2, y, 2 * REACH)
    here, there, out = start_of(image, channel, y), start_of(target, channel, y), start_of(g_image, channel, y)
    kind = channels * (height + 2 * REACH) * pitch
    place = 3 * kind + (channel * (height + 2 * REACH) + y) * pitch
    nothing = lanes.fill(ZERO)
    g_gain = g_offset = nothing
    for x in range(0, min(first, width), lanes.COUNT):
        if is_needed(GRADIENT, wanted, y, x):
            lanes.store_first(g_image, out + x, width - x, nothing)
    for x in range(first, last, lanes.COUNT):
        if not is_needed(GRADIENT, wanted, y, x):
            continue
        by_mean = filter_across_rows(scratch, place + x, pitch)
        by_square = filter_across_rows(scratch, place + kind + x, pitch)
        by_cross = filter_across_rows(scratch, place + 2 * kind + x, pitch)
        rendered = lanes.load_first(image, here + x, width - x)
        value = apply_exposure(rendered, gain, offset)
        truth = lanes.load_first(target, there + x, width - x)
        sign = lanes.choose(value > truth, lanes.fill(ONE), lanes.choose(value < truth, lanes.fill(-ONE), nothing))
        g = L1_SHARE * sign - SSIM_SHARE * (by_mean + TWO * value * by_square + truth * by_cross)
        g = lanes.only_first(share * g, width - x)
        g_gain += g * rendered
        g_offset += g
        lanes.store_first(g_image, out + x, width - x, g * gain)
    for x in range(max(min(first, width), last), width, lanes.COUNT):
        if is_needed(GRADIENT, wanted, y, x):
            lanes.store_first(g_image, out + x, width - x, nothing)
    g_exposure[channel, y, 0] = lanes.sum_of(g_gain)
    g_exposure[channel, y, 1] = lanes.sum_of(g_offset)


@inline
def band_of(task, bands, height):
    """Returns the channel, first row and last row + 1 of a task."""
    band = task % bands
    return task // bands, height * band // bands, height * (band + 1) // bands


@kernel
def loss_of_band(
    channel, begin, end, image, exposure, target, target_means, target_squares, weights, pixels, scratch, wanted,
    g_image, losses, g_exposure, spans,
):  # fmt: skip
    """Runs all passes of ``image_loss`` on the rows [begin, end) of a channel.

    Each pass depends on rows within ``REACH`` of the previous pass. Two bands compute the rows near their common
    border, and write the same values.

    Args:
        spans: [C, H, 4] scratch buffer; see ``span_of``.
    """
    height, pitch = target.shape[1], scratch.shape[3]
    gain, offset = exposure[channel, 0], exposure[channel, 1]
    rows = np.empty((3, pitch + 2 * PAD), np.float32)
    for y in range(max(0, begin - 4 * REACH), min(height, end + 4 * REACH)):
        span_of(image, gain, offset, target, channel, y, pitch, spans[channel, y])
    for y in range(max(0, begin - 2 * REACH), min(height, end + 2 * REACH)):
        windows_of_row(image, exposure, target, scratch, spans, rows, channel, y, wanted)
    for y in range(max(0, begin - REACH), min(height, end + REACH)):
        loss_of_row(
            image, exposure, target, target_means, target_squares, weights, pixels, scratch, spans, rows, losses,
            channel, y, wanted,
        )  # fmt: skip
    for y in range(begin, end):
        gradient_of_row(
            image, exposure, target, weights, pixels, scratch, spans, g_image, g_exposure, channel, y, wanted
        )


@parallel_kernel
def image_loss(
    bands, image, exposure, target, target_means, target_squares, weights, pixels, scratch, wanted, g_image, losses,
    g_exposure,
):  # fmt: skip
    """Computes the loss and gradient of a rendered image, or of part of one.

    Args:
        bands: number of bands per channel, from ``bands_of``. The result does not depend on it.
        image: [>= C, >= H, >= W] rendered image.
        exposure: [C, 2] gain and offset of the camera for each channel.
        target: [C, H, W] target image.
        target_means, target_squares: [C, H, W] results of ``target_moments``.
        weights: [C] weight of each channel's mean loss.
        pixels: number of pixels over which losses are averaged, H W for a full image.
        scratch: [6, C, H + 10, stride(W)] buffer for three windowed quantities and their gradients. The first and last
            5 rows must be 0.
        wanted: flags of the requested quantities; see ``near`` and ``EVERYWHERE``.
        g_image: [>= C, >= H, >= W] output, dL/dimage. The gradient is undefined where it is not
            requested.
        losses: [C, H, 2] output, loss contribution and sum of squared differences of each row.
        g_exposure: [C, H, 2] output, contribution of each row to the gradients of gain and offset.
    """
    channels, height, _ = target.shape
    spans = np.empty((channels, height, 4), np.int64)
    for task in prange(channels * bands):
        channel, begin, end = band_of(np.int64(task), bands, height)
        loss_of_band(
            channel, begin, end, image, exposure, target, target_means, target_squares, weights, pixels, scratch,
            wanted, g_image, losses, g_exposure, spans,
        )  # fmt: skip
