"""Estimation of camera gains on the device. Reference: ``engines.gains``."""

from __future__ import annotations

from math import log

import numpy as np
import warp as wp
from numpy.typing import NDArray

from scas4d_core.engines.exposure import (
    CAMERAS,
    DARK,
    ENOUGH,
    FOOT,
    LARGEST,
    LOOKED_AT,
    PIXELS,
    SATURATED,
    SHARE,
    gain_to_exposure,
)
from scas4d_core.engines.warp.downloads import Downloads
from scas4d_core.engines.warp.layout import Camera

wp.set_module_options({"enable_backward": False})

Array = NDArray[np.float32]

FOOT_, DARK_, SATURATED_, SHARE_, ENOUGH_, LOG_LARGEST = (
    wp.constant(wp.float32(value)) for value in (FOOT, DARK, SATURATED, SHARE, ENOUGH, log(LARGEST))
)
BLOCK = 256
"""Number of threads in the block that measures one channel."""
MOST_SAMPLED = 4 * LOOKED_AT
"""Maximum number of pixels sampled per image. It exceeds ``LOOKED_AT`` because the sampling step is rounded down."""


# The ratios are positive, so their bit patterns sort like their values. The element of a given rank is therefore found
# bit by bit, starting with the highest bit.
@wp.func_native("""
#if defined(__CUDA_ARCH__)
__shared__ int total;
const int threads = blockDim.x;
#else
int total;
const int threads = 1;
#endif
unsigned bound = 0;
for (int bit = 30; bit >= 0; --bit) {
    const unsigned next = bound | (1u << bit);
    int below = 0;
    for (int i = thread; i < count; i += threads) {
        union { float number; unsigned bits; } ratio;
        ratio.number = ratios.data[first + i];
        below += ratio.bits < next;
    }
#if defined(__CUDA_ARCH__)
    __syncthreads();
    if (thread == 0) total = 0;
    __syncthreads();
    atomicAdd(&total, below);
    __syncthreads();
#else
    total = below;
#endif
    if (total <= rank) bound = next;
}
union { float number; unsigned bits; } result;
result.bits = bound;
return result.number;
""")
def value_of_rank(
    thread: wp.int32, ratios: wp.array[wp.float32], first: wp.int32, count: wp.int32, rank: wp.int32
) -> wp.float32:
    """Returns the ``rank``-th smallest of ``count`` positive numbers, counting from 0 and starting at index ``first``.

    All threads of a block must call this function.
    """
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__syncthreads();
#endif
""")
def sync_block() -> None:
    """Synchronizes the threads of a block."""
    ...


@wp.kernel(module="unique", enable_backward=False)
def measure_gain(
    threads: wp.int32,
    cameras: wp.array[Camera],
    view: wp.array[wp.int32],
    planes: wp.array3d[wp.float32],
    targets: wp.array4d[wp.float32],
    ratios: wp.array[wp.float32],
    counts: wp.array[wp.int32],
    gain: wp.array[wp.float32],
) -> None:
    """Measures the gain of an image relative to its rendering, with one block per channel.

    Args:
        threads: number of threads per block, 1 on the CPU device.
        cameras: [views] cameras of all views.
        view: [1] index of the view.
        planes: [5, rows, columns] rendering, before the camera's exposure is applied.
        targets: [views, 4, rows, columns] training images and masks.
        ratios: [3 · ``MOST_SAMPLED``] scratch buffer.
        counts: [3] scratch buffer.
        gain: [3] output, median ratio of each channel, or NaN if there are too few usable pixels.
    """
    channel = wp.tid() // threads
    thread = wp.tid() - channel * threads
    camera = cameras[view[0]]
    every = wp.max(1, wp.int32(wp.sqrt(wp.float32(camera.width * camera.height) / wp.float32(LOOKED_AT))))
    across = (camera.width + every - 1) // every
    down = (camera.height + every - 1) // every
    first = channel * MOST_SAMPLED
    if thread == 0:
        counts[channel] = 0
    sync_block()
    for i in range(thread, across * down, threads):
        y = i // across
        x = every * (i - y * across)
        y = every * y
        here = targets[view[0], channel, y, x]
        there = planes[channel, y, x]
        if here > DARK_ and here < SATURATED_ and there > DARK_ and there < SATURATED_:
            ratios[first + wp.atomic_add(counts, channel, 1)] = (here + FOOT_) / (there + FOOT_)
    sync_block()
    count = counts[channel]
    median = wp.float32(wp.nan)
    if count >= PIXELS:
        low = value_of_rank(thread, ratios, first, count, (count - 1) // 2)
        median = 0.5 * (low + value_of_rank(thread, ratios, first, count, count // 2))
    if thread == 0:
        gain[channel] = median


@wp.func
def end_round(
    cameras: wp.int32, measured: wp.array2d[wp.float32], pending: wp.array[wp.int32], gains: wp.array2d[wp.float32]
) -> None:
    """Updates the gains from the measurements of one round; see ``exposure.update_gains``.

    Args:
        cameras: number of cameras that contribute to the frame.
        measured: [cameras, 3] measured gains.
        pending: [cameras] 1 for cameras measured in this round, otherwise 0. It is reset to 0.
        gains: [cameras, 3] current gains, updated in place.
    """
    known = wp.int32(0)
    for row in range(gains.shape[0]):
        if pending[row] == 1:
            if wp.isfinite(measured[row, 0] + measured[row, 1] + measured[row, 2]):
                known += 1
            else:
                pending[row] = 0
    if known >= CAMERAS and wp.float32(cameras) >= ENOUGH_ * wp.float32(gains.shape[0]):
        for k in range(3):
            mean = wp.float32(0.0)
            for row in range(gains.shape[0]):
                if pending[row] == 1:
                    mean += (wp.log(measured[row, k]) - wp.log(gains[row, k])) / wp.float32(known)
            for row in range(gains.shape[0]):
                if pending[row] == 1:
                    before = wp.log(gains[row, k])
                    after = before + SHARE_ * (wp.log(measured[row, k]) - before - mean)
                    gains[row, k] = wp.exp(wp.clamp(after, -LOG_LARGEST, LOG_LARGEST))
    for row in range(gains.shape[0]):
        pending[row] = 0


@wp.kernel
def record_gain(
    view: wp.array[wp.int32],
    rows: wp.array[wp.int32],
    takes_part: wp.array[wp.int32],
    views: wp.int32,
    gain: wp.array[wp.float32],
    measured: wp.array2d[wp.float32],
    pending: wp.array[wp.int32],
    gains: wp.array2d[wp.float32],
    exposures: wp.array2d[wp.vec2],
) -> None:
    """Records a measured gain. The second measurement of a camera starts a new round.

    The kernel is launched with one thread.

    Args:
        view: [1] index of the view, or −1 to end the round.
        rows: [views and probes] row of each view's camera in ``gains``.
        takes_part: [views and probes] 1 if the view's exposure follows the camera gain, otherwise 0.
        views: number of views, excluding probes.
        gain: [3] output of ``measure_gain``.
        measured, pending, gains: see ``end_round``.
        exposures: [views and probes, 4] gain and offset of each channel, updated when a round ends.
    """
    row = wp.int32(-1)
    if view[0] >= 0:
        row = rows[view[0]]
    ends = row < 0
    if row >= 0:
        ends = pending[row] == 1
    if ends:
        cameras = wp.int32(0)
        for k in range(views):
            cameras += takes_part[k]
        end_round(cameras, measured, pending, gains)
        for k in range(rows.shape[0]):
            if takes_part[k] == 1:
                for channel in range(3):
                    a = gains[rows[k], channel]
                    exposures[k, channel] = wp.vec2(a, FOOT_ * (a - 1.0))
    if row >= 0:
        pending[row] = 1
        for channel in range(3):
            measured[row, channel] = gain[channel]


class WarpGains:
    """Camera gains of an attempt, which determine the exposures of views and probes.

    Args:
        device: Warp device.
        cameras: number of cameras in the rig.
    """

    def __init__(self, device: str, cameras: int) -> None:
        self._device = device
        self._gains, self._measured = (wp.zeros((cameras, 3), dtype=wp.float32, device=device) for _ in range(2))
        self._pending = wp.zeros(cameras, dtype=wp.int32, device=device)
        self._gain = wp.zeros(3, dtype=wp.float32, device=device)
        self._ratios = wp.zeros(3 * MOST_SAMPLED, dtype=wp.float32, device=device)
        self._counts = wp.zeros(3, dtype=wp.int32, device=device)
        self._end = wp.full(1, -1, dtype=wp.int32, device=device)
        self._threads = BLOCK if wp.get_device(device).is_cuda else 1
        self._rows, self._views = wp.zeros(0, dtype=wp.int32, device=device), 0

    def load_views(self, rows: list[int], views: int) -> bool:
        """Loads the camera row of each view and probe.

        Args:
            rows: row of each view's camera in the gains, followed by the rows for the probes.
            views: number of views, excluding probes.

        Returns:
            Whether buffers were reallocated, which invalidates captured graphs.
        """
        replaced = bool(len(rows) != self._rows.shape[0] or views != self._views)
        if replaced:
            self._rows, self._takes_part = (wp.zeros(len(rows), dtype=wp.int32, device=self._device) for _ in range(2))
        self._host_rows, self._views = rows, views
        self._rows.assign(rows)
        return replaced

    def begin(self, gains: Array, exposures: wp.array) -> None:
        """Starts an attempt with the given gains.

        Args:
            gains: [cameras, 3] initial gains.
            exposures: [views and probes, 4] vec2 exposures, set to the initial gains.
        """
        self._gains.assign(gains)
        self._pending.zero_()
        self._takes_part.fill_(1)
        values = np.zeros((len(self._host_rows), 4, 2), np.float32)
        values[..., 0] = 1
        for place, row in enumerate(self._host_rows):
            values[place, :3] = gain_to_exposure(gains[row])
        exposures.assign(values)

    def leave_out(self, views: set[int]) -> None:
        """Excludes views from further rounds. The exposures of these views and their probes stay unchanged."""
        rows = {self._host_rows[view] for view in views}
        self._takes_part.assign([int(row not in rows) for row in self._host_rows])

    def record(
        self, cameras: wp.array, view: wp.array, planes: wp.array, targets: wp.array, exposures: wp.array
    ) -> None:
        """Measures a camera's gain from a rendering; see ``measure_gain`` and ``record_gain`` for the arguments."""
        inputs = [self._threads, cameras, view, planes, targets, self._ratios, self._counts, self._gain]
        wp.launch(measure_gain, 3 * self._threads, inputs, device=self._device, block_dim=BLOCK)
        self._record(view, exposures)

    def _record(self, view: wp.array, exposures: wp.array) -> None:
        given = [view, self._rows, self._takes_part, self._views, self._gain]
        state = [self._measured, self._pending, self._gains, exposures]
        wp.launch(record_gain, 1, given + state, device=self._device)

    def finish(self, exposures: wp.array, downloads: Downloads) -> Array:
        """Ends the round, waits for the device, and returns the gains [cameras, 3]."""
        self._record(self._end, exposures)
        (gains,) = downloads.read(self._gains)
        return gains
