"""Image loss 0.8 L1 + 0.2 (1 − SSIM) of views, and its gradient. Reference: ``engines.torch.losses``.

SSIM follows 3D Gaussian Splatting: 11×11 Gaussian window, sigma 1.5, zero padding. Each thread computes four pixels of
a column. It filters the 14 rows of their windows horizontally, and accumulates each row for all four pixels. Filtered
rows are recomputed rather than stored. Arithmetic is cheap, because a single image occupies only a tenth of a GPU.
"""

from __future__ import annotations

from collections.abc import Sequence
from weakref import WeakSet

import numpy as np
import warp as wp
from numpy.typing import NDArray

from scas4d_core.engines.renderer import CHANNELS
from scas4d_core.engines.views import TrainingView
from scas4d_core.engines.warp.layout import IMAGE_LOSS, MASK_LOSS, SHIFT, SQUARES, TILE, Camera, camera_of
from scas4d_core.engines.warp.rasterizer import Rasterizer
from scas4d_core.guards import SSIM_C1, SSIM_C2

# Unrolling the window loops would exhaust the registers. Their length is therefore a runtime argument.
wp.set_module_options({"enable_backward": False, "max_unroll": 4})

Array = NDArray[np.float32]

REACH = 5
"""Radius of the window in pixels."""
ROWS = 4
"""Number of pixels per thread."""

_taps = np.exp(-((np.arange(2 * REACH + 1) - REACH) ** 2) / (2 * 1.5**2))
_taps /= _taps.sum()
PADDED_TAPS = np.float32([0.0] * (ROWS - 1) + _taps.tolist() + [0.0] * (ROWS - 1))
"""[17] window weights, padded with zeros for rows that are outside the window of some of the four pixels."""
PAD = ROWS - 1
C1 = wp.constant(wp.float32(SSIM_C1))
C2 = wp.constant(wp.float32(SSIM_C2))
LEVEL = wp.constant(wp.float32(1 / 255))
L1_PART = wp.constant(wp.float32(0.8))
SSIM_PART = wp.constant(wp.float32(0.2))


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return threadIdx.x == 0;
#else
return 1;
#endif
""")
def leads() -> wp.int32:
    """Returns 1 in a thread that receives the result of ``sum_over_block`` (every thread on the CPU), otherwise 0."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__shared__ float parts[3][32];
float x = value[0], y = value[1], z = value[2];
for (int k = 16; k > 0; k >>= 1) {
    x += __shfl_xor_sync(0xffffffffu, x, k);
    y += __shfl_xor_sync(0xffffffffu, y, k);
    z += __shfl_xor_sync(0xffffffffu, z, k);
}
const int warp = threadIdx.x >> 5, warps = blockDim.x >> 5;
__syncthreads();
if ((threadIdx.x & 31) == 0) {
    parts[0][warp] = x;
    parts[1][warp] = y;
    parts[2][warp] = z;
}
__syncthreads();
if (threadIdx.x == 0)
    for (int k = 1; k < warps; ++k) {
        x += parts[0][k];
        y += parts[1][k];
        z += parts[2][k];
    }
return wp::vec_t<3, wp::float32>(x, y, z);
#else
return value;
#endif
""")
def sum_over_block(value: wp.vec3) -> wp.vec3:
    """Returns the sum over a block, in the block's first thread. All threads of the block must call this function."""
    ...


@wp.struct
class Place:
    """Inputs of a thread that computes losses: view, channel, image size, first pixel, exposure and weight."""

    view: wp.int32
    channel: wp.int32
    width: wp.int32
    height: wp.int32
    x: wp.int32
    y: wp.int32
    shown: wp.int32  # 1 if the first pixel is inside the image
    compared: wp.int32  # 1 if the target has this channel
    gain: wp.float32
    offset: wp.float32
    share: wp.float32  # weight of one pixel in the loss


@wp.func
def place_of(
    cameras: wp.array[Camera], channels: wp.array[wp.int32], view: wp.array[wp.int32],
    exposures: wp.array2d[wp.vec2], weights: wp.vec4, channel: wp.int32, band: wp.int32, x: wp.int32,
) -> Place:  # fmt: skip
    """Returns the inputs of the thread for a channel, a band of ``ROWS`` rows, and a column."""
    here = Place()
    here.view = view[0]
    here.channel = channel
    camera = cameras[here.view]
    here.width = camera.width
    here.height = camera.height
    here.x = x
    here.y = band * ROWS
    exposure = exposures[here.view, channel]
    here.gain = exposure[0]
    here.offset = exposure[1]
    here.share = weights[channel] / (wp.float32(here.width) * wp.float32(here.height))
    if x < here.width and here.y < here.height:
        here.shown = 1
        if channel < channels[here.view]:
            here.compared = 1
    return here


@wp.kernel
def target_moments(
    changed: wp.array[wp.int32],
    cameras: wp.array[Camera],
    window: wp.int32,
    taps: wp.array[wp.float32],
    targets: wp.array4d[wp.float32],
    means: wp.array4d[wp.float32],
    squares: wp.array4d[wp.float32],
) -> None:
    """Computes the windowed means of targets and of their squares, with one thread per pixel.

    Args:
        changed: indices of the views whose targets changed.
        cameras, window, taps: see ``picture_loss``.
        targets: [views, 4, rows, columns] training images and masks.
        means, squares: [views, 4, rows, columns] outputs. Values outside an image stay unchanged.
    """
    place, channel, y, x = wp.tid()
    view = changed[place]
    camera = cameras[view]
    if x < camera.width and y < camera.height:
        mean = wp.float32(0.0)
        square = wp.float32(0.0)
        for down in range(window):
            row = y + down - REACH
            if row >= 0 and row < camera.height:
                sum_mean = wp.float32(0.0)
                sum_square = wp.float32(0.0)
                for across in range(window):
                    column = x + across - REACH
                    if column >= 0 and column < camera.width:
                        value = targets[view, channel, row, column]
                        sum_mean += taps[across + PAD] * value
                        sum_square += taps[across + PAD] * value * value
                tap = taps[down + PAD]
                mean += tap * sum_mean
                square += tap * sum_square
        means[view, channel, y, x] = mean
        squares[view, channel, y, x] = square


@wp.kernel
def expand_levels(
    view: wp.int32,
    channels: wp.int32,
    levels: wp.array4d[wp.uint8],
    targets: wp.array4d[wp.float32],
) -> None:
    """Converts an 8-bit image and its mask to a target, with one thread per pixel and channel.

    Args:
        view: index of the view.
        channels: number of channels of the target.
        levels: [views, 4, rows, columns] image in 0…255, and mask in [0, 1].
        targets: [views, 4, rows, columns] output.
    """
    channel, y, x = wp.tid()
    if channel < channels:
        level = wp.float32(levels[view, channel, y, x])
        targets[view, channel, y, x] = wp.where(channel < 3, level * LEVEL, level)


@wp.kernel
def average_area(
    finer: wp.array3d[wp.float32], rows: wp.int32, columns: wp.int32, target: wp.array3d[wp.float32]
) -> None:
    """Resizes planes by area averaging, with one thread per resulting pixel and channel.

    Args:
        finer: [C, H, W] planes.
        rows, columns: size of the result. If it is the size of ``finer``, the planes are copied.
        target: [C, rows or more, columns or more] output.
    """
    channel, y, x = wp.tid()
    down = wp.float32(finer.shape[1]) / wp.float32(rows)
    across = wp.float32(finer.shape[2]) / wp.float32(columns)
    top = wp.float32(y) * down
    left = wp.float32(x) * across
    total = wp.float32(0.0)
    for row in range(wp.int32(top), wp.min(wp.int32(wp.ceil(top + down)), finer.shape[1])):
        tall = wp.min(top + down, wp.float32(row + 1)) - wp.max(top, wp.float32(row))
        line = wp.float32(0.0)
        for column in range(wp.int32(left), wp.min(wp.int32(wp.ceil(left + across)), finer.shape[2])):
            wide = wp.min(left + across, wp.float32(column + 1)) - wp.max(left, wp.float32(column))
            line += wide * finer[channel, row, column]
        total += tall * line
    target[channel, y, x] = total / (down * across)


@wp.kernel
def find_blank(
    changed: wp.array[wp.int32],
    cameras: wp.array[Camera],
    targets: wp.array4d[wp.float32],
    blank: wp.array3d[wp.int32],
) -> None:
    """Marks the tiles in which a target is zero everywhere, with one thread per tile.

    Args:
        changed: indices of the views whose targets changed.
        cameras: [views] cameras of all views.
        targets: [views, 4, rows, columns] training images and masks.
        blank: [views, tile rows, tile columns] output, 1 for blank tiles, otherwise 0.
    """
    place, tile_y, tile_x = wp.tid()
    view = changed[place]
    camera = cameras[view]
    found = wp.int32(1)
    for channel in range(4):
        for y in range(tile_y * TILE, wp.min(tile_y * TILE + TILE, camera.height)):
            for x in range(tile_x * TILE, wp.min(tile_x * TILE + TILE, camera.width)):
                if targets[view, channel, y, x] != 0.0:
                    found = wp.int32(0)
    blank[view, tile_y, tile_x] = found


@wp.func
def nothing_near(
    here: Place, tiles_x: wp.int32, starts: wp.array[wp.int32], background: wp.array[wp.vec4],
    blank: wp.array3d[wp.int32],
) -> wp.bool:  # fmt: skip
    """Returns whether rendering and target are zero in all windows of a thread's pixels."""
    nothing = here.offset == 0.0 and background[0][here.channel] == 0.0
    if nothing:
        x1 = wp.min(here.x + REACH, here.width - 1) // TILE
        y1 = wp.min(here.y + ROWS - 1 + REACH, here.height - 1) // TILE
        for y in range(wp.max(here.y - REACH, 0) // TILE, y1 + 1):
            for x in range(wp.max(here.x - REACH, 0) // TILE, x1 + 1):
                tile = y * tiles_x + x
                nothing = nothing and starts[tile + 1] == starts[tile] and blank[here.view, y, x] == 1
    return nothing


@wp.kernel
def picture_loss(
    cameras: wp.array[Camera],
    channels: wp.array[wp.int32],
    view: wp.array[wp.int32],
    record: wp.array[wp.int32],
    window: wp.int32,
    taps: wp.array[wp.float32],
    exposures: wp.array2d[wp.vec2],
    weights: wp.vec4,
    planes: wp.array3d[wp.float32],
    targets: wp.array4d[wp.float32],
    means: wp.array4d[wp.float32],
    squares: wp.array4d[wp.float32],
    tiles_x: wp.int32,
    starts: wp.array[wp.int32],
    background: wp.array[wp.vec4],
    blank: wp.array3d[wp.int32],
    everywhere: wp.int32,
    by_window: wp.array3d[wp.vec3],
    log: wp.array2d[wp.float32],
) -> None:
    """Accumulates a view's loss, and stores its derivatives with respect to the windowed quantities of SSIM.

    Windows in which both the rendering and the target are zero have zero loss. Unless ``everywhere`` is 1, their
    derivatives are neither written nor read.

    The launch dimensions are [4, bands of ``ROWS`` rows, columns], and each block covers one channel.

    Args:
        cameras: [views] cameras of all views.
        channels: [views] number of channels of each target.
        view: [1] index of the view.
        record: [1] row of the log.
        window: width of the window, 11.
        taps: window weights, ``PADDED_TAPS``.
        exposures: [views, 4] gain and offset of each channel.
        weights: weight of each channel's mean loss.
        planes: [4 or more, rows, columns] rendering.
        targets, means, squares: see ``target_moments``.
        tiles_x: number of tile columns.
        starts: first entry of each tile list of the rendering.
        background: [1] background features.
        blank: see ``find_blank``.
        everywhere: 1 to write all derivatives, otherwise 0.
        by_window: [4, rows, columns] output, derivatives with respect to the windowed mean, mean square and mean
            product.
        log: [records, ``COLUMNS``] log, to which losses, squares and colour shift are added.
    """
    channel, band, x = wp.tid()
    at = place_of(cameras, channels, view, exposures, weights, channel, band, x)
    loss = wp.float32(0.0)
    squared = wp.float32(0.0)
    shift = wp.float32(0.0)
    if at.compared == 1 and (everywhere == 1 or not nothing_near(at, tiles_x, starts, background, blank)):
        mean = wp.vec4(0.0, 0.0, 0.0, 0.0)
        square = wp.vec4(0.0, 0.0, 0.0, 0.0)
        product = wp.vec4(0.0, 0.0, 0.0, 0.0)
        for down in range(window + PAD):
            row = at.y + down - REACH
            if row >= 0 and row < at.height:
                sum_mean = wp.float32(0.0)
                sum_square = wp.float32(0.0)
                sum_product = wp.float32(0.0)
                for across in range(window):
                    column = x + across - REACH
                    if column >= 0 and column < at.width:
                        value = at.gain * planes[channel, row, column] + at.offset
                        weighted = taps[across + PAD] * value
                        sum_mean += weighted
                        sum_square += weighted * value
                        sum_product += weighted * targets[at.view, channel, row, column]
                rows = wp.vec4(taps[down + 3], taps[down + 2], taps[down + 1], taps[down])
                mean += rows * sum_mean
                square += rows * sum_square
                product += rows * sum_product
        for k in range(ROWS):
            y = at.y + k
            if y < at.height:
                m1 = mean[k]
                m2 = means[at.view, channel, y, x]
                a1 = 2.0 * m1 * m2 + C1
                a2 = 2.0 * (product[k] - m1 * m2) + C2
                b1 = m1 * m1 + m2 * m2 + C1
                b2 = square[k] - m1 * m1 + squares[at.view, channel, y, x] - m2 * m2 + C2
                inverse = 1.0 / (b1 * b2)
                ssim = a1 * a2 * inverse
                by_product = 2.0 * a1 * inverse
                by_square = -ssim * b1 * inverse
                by_mean = 2.0 * (m2 * a2 * inverse - ssim * m1 * b2 * inverse - m1 * by_square) - m2 * by_product
                by_window[channel, y, x] = wp.vec3(by_mean, by_square, by_product)
                value = at.gain * planes[channel, y, x] + at.offset
                difference = value - targets[at.view, channel, y, x]
                loss += L1_PART * wp.abs(difference) + SSIM_PART * (1.0 - ssim)
                squared += difference * difference
                shift -= difference
    sums = sum_over_block(wp.vec3(loss, squared, shift))
    if leads() == 1 and channel < channels[at.view]:
        row = record[0]
        if channel < 3:
            wp.atomic_add(log, row, IMAGE_LOSS, at.share * sums[0])
            wp.atomic_add(log, row, SQUARES, sums[1])
            wp.atomic_add(log, row, SHIFT + channel, sums[2] / (wp.float32(at.width) * wp.float32(at.height)))
        else:
            wp.atomic_add(log, row, MASK_LOSS, at.share * sums[0])


@wp.kernel
def picture_gradient(
    cameras: wp.array[Camera],
    channels: wp.array[wp.int32],
    view: wp.array[wp.int32],
    window: wp.int32,
    taps: wp.array[wp.float32],
    exposures: wp.array2d[wp.vec2],
    weights: wp.vec4,
    planes: wp.array3d[wp.float32],
    targets: wp.array4d[wp.float32],
    tiles_x: wp.int32,
    starts: wp.array[wp.int32],
    everywhere: wp.int32,
    by_window: wp.array3d[wp.vec3],
    g_planes: wp.array3d[wp.float32],
) -> None:
    """Computes the gradient of a view's loss with respect to the planes.

    The launch dimensions are those of ``picture_loss``.

    Unless ``everywhere`` is 1, tiles with empty lists are not written, because no Gaussian has a gradient there.

    Args:
        cameras, channels, view, window, taps, exposures, planes, targets, tiles_x, starts: see ``picture_loss``.
        weights: weight of each channel's mean loss, multiplied by the scale factor of the gradient.
        everywhere: 1 to write all pixels, otherwise 0.
        by_window: output of ``picture_loss``.
        g_planes: [4, rows, columns] output, gradient of the planes. It is 0 in channels that the target does not have.
    """
    channel, band, x = wp.tid()
    at = place_of(cameras, channels, view, exposures, weights, channel, band, x)
    some = wp.int32(0)
    if at.shown == 1:
        tile = (at.y // TILE) * tiles_x + x // TILE
        some = starts[tile + 1] - starts[tile] + everywhere
    if some > 0:
        by_mean = wp.vec4(0.0, 0.0, 0.0, 0.0)
        by_square = wp.vec4(0.0, 0.0, 0.0, 0.0)
        by_product = wp.vec4(0.0, 0.0, 0.0, 0.0)
        if at.compared == 1:
            for down in range(window + PAD):
                row = at.y + down - REACH
                if row >= 0 and row < at.height:
                    sums = wp.vec3(0.0, 0.0, 0.0)
                    for across in range(window):
                        column = x + across - REACH
                        if column >= 0 and column < at.width:
                            sums += taps[across + PAD] * by_window[channel, row, column]
                    rows = wp.vec4(taps[down + 3], taps[down + 2], taps[down + 1], taps[down])
                    by_mean += rows * sums[0]
                    by_square += rows * sums[1]
                    by_product += rows * sums[2]
        for k in range(ROWS):
            y = at.y + k
            if y < at.height:
                g = wp.float32(0.0)
                if at.compared == 1:
                    value = at.gain * planes[channel, y, x] + at.offset
                    target = targets[at.view, channel, y, x]
                    sign = wp.where(value > target, 1.0, wp.where(value < target, -1.0, 0.0))
                    spread = by_mean[k] + 2.0 * value * by_square[k] + target * by_product[k]
                    g = at.gain * at.share * (L1_PART * sign - SSIM_PART * spread)
                g_planes[channel, y, x] = g


@wp.kernel
def exposure_gradient(
    cameras: wp.array[Camera],
    view: wp.array[wp.int32],
    exposures: wp.array2d[wp.vec2],
    planes: wp.array3d[wp.float32],
    g_planes: wp.array3d[wp.float32],
    gradients: wp.array[wp.vec2],
) -> None:
    """Accumulates the gradients of gain and offset, with one thread per channel and column.

    Args:
        cameras: [views] cameras of all views.
        view: [1] index of the view.
        exposures: [views, 4] gain and offset of each channel.
        planes: [4 or more, rows, columns] rendering.
        g_planes: [4, rows, columns] gradient of the planes, filled for all pixels.
        gradients: [4] gradients of gain and offset, accumulated.
    """
    channel, x = wp.tid()
    camera = cameras[view[0]]
    if x < camera.width:
        by_gain = wp.float32(0.0)
        by_offset = wp.float32(0.0)
        for y in range(camera.height):
            g = g_planes[channel, y, x]
            by_gain += g * planes[channel, y, x]
            by_offset += g
        wp.atomic_add(gradients, channel, wp.vec2(by_gain, by_offset) / exposures[view[0], channel][0])


_instances: WeakSet[PictureLoss] = WeakSet()
"""All instances of ``PictureLoss``, which share the images of a frame."""


class PictureLoss:
    """The training images of a frame on a device, and the loss of a rendering compared with one of these images.

    Args:
        device: Warp device, such as "cpu" or "cuda:0".
        image_weight, mask_weight: weights of the image and mask losses.
        everywhere: whether gradients are also needed at pixels without Gaussians, for example to learn exposures.

    Attributes:
        columns, rows: size of the largest image so far, in pixels.
        cameras: [views] cameras of all views, of type ``Camera``.
        exposures: [views, 4] vec2 gain and offset of each channel.
    """

    def __init__(self, device: str, image_weight: float, mask_weight: float, everywhere: bool = False) -> None:
        self._device, self._everywhere = device, int(everywhere)
        self._weights = [image_weight / 3] * 3 + [mask_weight]
        self._taken: list[Array | None] = []
        _instances.add(self)
        self._sent: wp.Event | None = None
        self._window = 2 * REACH + 1, wp.array(PADDED_TAPS, dtype=wp.float32, device=device)
        self.columns = self.rows = 0

    def load(self, views: Sequence[TrainingView]) -> bool:
        """Uploads the images, cameras and exposures of a frame.

        Images that are already loaded are reused. Images that this or another instance has loaded are copied on the
        device. Area averages of earlier views are computed on the device.

        Returns:
            Whether buffers were reallocated, which invalidates captured graphs.
        """
        columns = max(self.columns, *(view.camera.width for view in views))
        rows = max(self.rows, *(view.camera.height for view in views))
        replaced = columns > self.columns or rows > self.rows or len(views) > len(self._taken)
        if replaced:
            self._allocate(max(len(views), len(self._taken)), columns, rows)
        floats, levels = list[int](), list[int]()
        copied: list[tuple[int, wp.array]] = []
        taken: dict[int, Array] = {}
        loaded = dict[int, int]()
        for index, view in enumerate(views):
            channels, height, width = view.target.shape
            self._host_channels[index] = channels
            self._host_exposures[index, :channels] = view.exposure
            if self._taken[index] is not view.target:
                taken[index] = view.target
                if (same := self._loaded(view.target, loaded)) is not None:
                    copied.append((index, same[:channels, :height, :width]))
                elif view.finer is not None and (finer := self._loaded(view.finer, loaded)) is not None:
                    rows_there, columns_there = view.finer.shape[1:]
                    copied.append((index, finer[:channels, :rows_there, :columns_there]))
                elif view.source is None:
                    self._wait_for_upload()
                    if index not in self._staged_floats:
                        self._staged_floats[index] = self._pinned()
                    self._staged_floats[index].numpy()[:channels, :height, :width] = view.target
                    floats.append(index)
                else:
                    self._wait_for_upload()
                    image, mask = view.source
                    self._host_levels[index, :3, :height, :width] = np.moveaxis(image, -1, 0)
                    if mask is not None:
                        self._host_levels[index, 3, :height, :width] = mask
                    levels.append(index)
            loaded[id(view.target)] = index
        cameras = [camera_of(view.camera) for view in views]
        wp.copy(self.cameras, wp.array(cameras, dtype=Camera, device="cpu"), count=len(views))
        for there, here in ((self.channels, self._host_channels), (self.exposures, self._host_exposures)):
            wp.copy(there, wp.array(here, dtype=there.dtype, device="cpu"))
        size = self.targets.size // len(self._taken)
        for index in floats:
            wp.copy(self.targets, self._staged_floats[index], size * index, 0, size)
        for index in levels:  # a quarter of the bytes
            used = size * int(self._host_channels[index]) // CHANNELS  # without the mask if there is none
            wp.copy(self._levels, self._staged_levels, size * index, size * index, used)
        for index in levels:
            inputs = [index, int(self._host_channels[index]), self._levels, self.targets]
            wp.launch(expand_levels, self.targets.shape[1:], inputs, device=self._device)
        for index, target in copied:
            shape = views[index].target.shape
            wp.launch(average_area, shape, [target, *shape[1:], self.targets[index]], device=self._device)
        if changed := floats + levels + [index for index, _ in copied]:
            places = wp.array(changed, dtype=wp.int32, device=self._device)
            inputs = [places, self.cameras, *self._window, self.targets, self.target_means, self.target_squares]
            wp.launch(target_moments, (len(changed), *self.targets.shape[1:]), inputs, device=self._device)
            inputs = [places, self.cameras, self.targets, self._blank]
            wp.launch(find_blank, (len(changed), *self._blank.shape[1:]), inputs, device=self._device)
        for index, target in taken.items():  # only now, because an upload may fail if memory is full
            self._taken[index] = target
        if (floats or levels) and wp.get_device(self._device).is_cuda:
            self._sent = wp.get_stream(self._device).record_event(self._sent)
        return replaced

    def _wait_for_upload(self) -> None:
        """Waits for the last upload of images, if any, because its page-locked buffers are about to be overwritten."""
        if self._sent is not None:
            wp.synchronize_event(self._sent)

    def _loaded(self, target: Array, loaded: dict[int, int]) -> wp.array | None:
        """Returns the device copy [4, rows, columns] of a target that is loaded, or None.

        Args:
            target: target to look for.
            loaded: indices of the targets that this instance has loaded and will not overwrite, keyed by id.
        """
        if id(target) in loaded:
            return self.targets[loaded[id(target)]]
        for other in _instances:
            if other is not self and other._device == self._device:
                for index, taken in enumerate(other._taken):
                    if taken is target:
                        return other.targets[index]
        return None

    def _pinned(self) -> wp.array:
        """Returns a page-locked float32 buffer for one image of the maximum size."""
        pinned = wp.get_device(self._device).is_cuda
        return wp.zeros(self.targets.shape[1:], dtype=wp.float32, device="cpu", pinned=pinned)

    def measure(
        self, view: wp.array, record: wp.array, drawn: Rasterizer, background: wp.array, log: wp.array
    ) -> None:  # fmt: skip
        """Adds the loss of a view's rendering to a log row; see ``picture_loss``.

        Args:
            view: [1] index of the view.
            record: [1] row of the log.
            drawn: rasterizer that contains the rendering.
            background: [1] vec4 background features.
            log: [records, ``COLUMNS``] log.
        """
        given = [self.cameras, self.channels, view, record, *self._window, self.exposures, wp.vec4(*self._weights)]
        targets = [drawn.planes, self.targets, self.target_means, self.target_squares]
        kept = [drawn.tiles_x, drawn.starts, background, self._blank, self._everywhere, self._by_window, log]
        wp.launch(picture_loss, self._threads, given + targets + kept, device=self._device)

    def carry_back(self, view: wp.array, drawn: Rasterizer, weight: float) -> None:
        """Fills ``drawn.g_planes`` with the gradient of the last measured loss, scaled by ``weight``."""
        weights = wp.vec4(*(weight * each for each in self._weights))
        given = [self.cameras, self.channels, view, *self._window, self.exposures, weights]
        kept = [drawn.planes, self.targets, drawn.tiles_x, drawn.starts, self._everywhere, self._by_window]
        kept += [drawn.g_planes]
        wp.launch(picture_gradient, self._threads, given + kept, device=self._device)

    def exposure_gradient(self, view: wp.array, drawn: Rasterizer, gradients: wp.array) -> None:
        """Fills ``gradients`` [4] (vec2) with the gradients of the view's gain and offset, using ``drawn.g_planes``."""
        gradients.zero_()
        inputs = [self.cameras, view, self.exposures, drawn.planes, drawn.g_planes, gradients]
        wp.launch(exposure_gradient, (CHANNELS, self.columns), inputs, device=self._device)

    def set_exposure(self, index: int, view: TrainingView) -> None:
        """Uploads the current exposure of a loaded view."""
        values = np.tile(np.array([1, 0], np.float32), (CHANNELS, 1))
        values[: len(view.exposure)] = view.exposure
        self.exposures[index].assign(values)

    def _allocate(self, views: int, columns: int, rows: int) -> None:
        """Allocates buffers for the given number of views and image size, and marks all images for upload."""
        device, shape = self._device, (views, CHANNELS, rows, columns)
        pinned = wp.get_device(device).is_cuda
        self.columns = self.rows = 0  # if memory is full, the next call allocates everything again
        # Blocks must not span two channels.
        bands = -(-rows // ROWS)
        self._taken = [None] * views
        self._threads = (CHANNELS, -(-bands // 8) * 8, -(-columns // 32) * 32)
        self.cameras = wp.zeros(views, dtype=Camera, device=device)
        self.channels = wp.zeros(views, dtype=wp.int32, device=device)
        self.exposures = wp.zeros((views, CHANNELS), dtype=wp.vec2, device=device)
        self.targets = wp.zeros(shape, dtype=wp.float32, device=device)
        self.target_means, self.target_squares = (wp.zeros_like(self.targets) for _ in range(2))
        self._blank = wp.zeros((views, -(-rows // TILE), -(-columns // TILE)), dtype=wp.int32, device=device)
        self._by_window = wp.zeros(shape[1:], dtype=wp.vec3, device=device)
        self._staged_floats: dict[int, wp.array] = {}
        self._levels = wp.zeros(shape, dtype=wp.uint8, device=device)
        self._staged_levels = wp.zeros(shape, dtype=wp.uint8, device="cpu", pinned=pinned)
        self._host_levels = self._staged_levels.numpy()  # a view of the same memory
        self._host_channels = np.zeros(views, np.int32)
        self._host_exposures = np.tile(np.array([1, 0], np.float32), (views, CHANNELS, 1))
        self.columns, self.rows = columns, rows
