"""CPU rasterizer: projection, depth sorting, tile lists and blending, with backward passes for all stages.

The forward and backward passes of a view share buffers, which are reused for later views and never shrink. Results do
not depend on the number of threads. Reference implementation: ``engines.torch.rasterizer``.

Gaussians with non-finite values or an overflowing footprint are not rendered and receive zero gradients. Overflowing
gradients are also set to 0. ``CpuRasterizer.guards`` counts these events.
"""

from __future__ import annotations

from math import prod
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.cpu.blocks import tile_grid
from scas4d_core.engines.limits import DEFAULT, Limits
from scas4d_core.engines.renderer import Gradients, Picture
from scas4d_core.engines.views import CameraArrays
from scas4d_core.guards import GuardCounts
from scas4d_core.kernels import balance, feature_gradients, projection, tiles
from scas4d_core.kernels import blend as blend_kernels
from scas4d_core.kernels import pairs as pair_kernels
from scas4d_core.kernels.jit import threads
from scas4d_core.kernels.projection import TILE

Array = NDArray[np.float32]

TILE_COST = 20
"""Cost of a tile with an empty list, relative to that of a list entry."""


class Drawing(NamedTuple):
    """Selection of the image blocks to render. All other blocks are neither read nor written.

    Attributes:
        blocks: [tiles] uint64 bitmask of the selected blocks in each tile. See ``tiles.cover`` for the bit order.
        learnt: [N] uint8 mask of the Gaussians that receive gradients. If such a Gaussian extends beyond ``blocks``,
            ``CpuRasterizer.outside_region`` is set.
        mask_to_region: whether to render only the blocks covered by the ``learnt`` Gaussians; see
            ``CpuRasterizer.drawn``.
    """

    blocks: NDArray[np.uint64]
    learnt: NDArray[np.uint8]
    mask_to_region: bool = False


class ForwardPass(NamedTuple):
    """Inputs and buffers of a forward pass that the backward pass needs. They are valid until the next forward pass."""

    means: Array
    factors: Array
    features: Array
    camera: CameraArrays
    depth_channel: int
    splats: Array
    counts: NDArray[np.int32]
    firsts: NDArray[np.int64]
    starts: NDArray[np.int64]
    items: NDArray[np.int32]
    slots: NDArray[np.int32]
    covers: NDArray[np.uint64]
    learnt: NDArray[np.uint8]
    tile_order: NDArray[np.int64]
    shares: NDArray[np.int64]
    image: Array
    transmittance: Array
    pairs: int


class CpuRasterizer:
    """Rasterizer that renders any number of feature channels in one pass and backpropagates their gradients.

    Attributes:
        guards: number of times each guard was triggered since the last ``reset``.
        limits: [6] float32 rasterizer constants, in the order of the ``Limits`` fields.
        outside_region: whether a ``learnt`` Gaussian covered a block that the last forward pass did not render.
        drawn: [tiles] uint64 bitmask of the blocks that the last forward pass rendered.

    >>> from scas4d_core.cameras import Camera
    >>> from scas4d_core.gaussians import Gaussians
    >>> state = Gaussians.of_points([[0, 0, 2]], radius=0.1, colours=[1, 0, 0])
    >>> camera = Camera("front", [[100, 0, 8], [0, 100, 8], [0, 0, 1]], np.eye(4), 16, 16)
    >>> features = np.concatenate([state.colours, np.zeros((1, 1), np.float32)], axis=1)  # in groups of four
    >>> rasterizer = CpuRasterizer()
    >>> picture = rasterizer.forward(
    ...     state.means, state.factors, state.opacities, features, CameraArrays.of(camera), np.zeros(4, np.float32)
    ... )
    >>> picture.features[:, 8, 8].round(2), round(float(picture.transmittance[8, 8]), 2)
    (array([0.89, 0.  , 0.  , 0.  ], dtype=float32), 0.11)
    >>> g_image, g_alpha = rasterizer.gradient_buffers()
    >>> g_image[0, :16, :16] = 1  # gradient of the sum of red over all pixels
    >>> rasterizer.backward(g_image, g_alpha).features.round(0)
    array([[113.,   0.,   0.,   0.]], dtype=float32)
    """

    def __init__(self, limits: Limits = DEFAULT) -> None:
        self.guards = GuardCounts(*projection.COUNTED_GUARDS, *projection.COUNTED_GUARDS_BACKWARD)
        self.limits = np.array(limits, dtype=np.float32)
        self.outside_region = False
        self.drawn = np.zeros(0, np.uint64)
        self._last: ForwardPass
        self._buffers: dict[str, NDArray[Any]] = {}
        self._views: dict[str, NDArray[Any]] = {}
        self._gradient_shape: tuple[int, ...] = ()
        self._histogram = np.empty(tiles.DIGITS, np.int64)

    def _buffer(self, name: str, shape: tuple[int, ...], dtype: Any = np.float32) -> NDArray[Any]:
        """Returns a contiguous scratch array. Its memory has a reserve of 25% to avoid reallocations as sizes vary."""
        view = self._views.get(name)
        if view is not None and view.shape == shape:
            return view
        size = prod(shape)
        flat = self._buffers.get(name)
        if flat is None or flat.size < size:
            flat = np.empty(size + size // 4, dtype)
            self._buffers[name] = flat
        self._views[name] = flat[:size].reshape(shape)
        return self._views[name]

    def project(
        self, means: Array, factors: Array, opacities: Array, features: Array, camera: CameraArrays
    ) -> tuple[Array, NDArray[np.int32], NDArray[np.int32]]:
        """Projects Gaussians without rendering them; see ``projection.project``.

        Args:
            means, factors, opacities, features, camera: see ``forward``.

        Returns:
            Buffers with the splats [N, 16], rects [N, 4] and counts [N] of ``projection.project``.
        """
        count = len(means)
        # The projection kernel writes full groups of sixteen rows.
        splats = self._buffer("splats", (count + 15, projection.SPLAT_COLUMNS))[:count]
        rects = self._buffer("rects", (count, 4), np.int32)
        counts = self._buffer("counts", (count,), np.int32)
        guard_counts = self._buffer(
            "guard_counts", (-(-count // projection.CHUNK), len(projection.COUNTED_GUARDS)), np.int64
        )
        projection.project(
            means,
            factors,
            opacities,
            features,
            camera.pose,
            camera.lens,
            self.limits,
            splats,
            rects,
            counts,
            guard_counts,
        )
        if guard_counts.any():
            self.guards.add(projection.COUNTED_GUARDS, guard_counts)
        return splats, rects, counts

    def forward(
        self,
        means: Array,
        factors: Array,
        opacities: Array,
        features: Array,
        camera: CameraArrays,
        background: Array,
        depth_channel: int = -1,
        drawing: Drawing | None = None,
    ) -> Picture:
        """Renders the features and transmittance of one view. All arrays are float32 and C-contiguous.

        Args:
            means: [N, 3] means, in metres.
            factors: [N, 3, 3] covariance factors.
            opacities: [N] opacities.
            features: [N, C] features. C must be a multiple of 4.
            camera: camera in internal world coordinates.
            background: [C] background features.
            depth_channel: channel of ``features`` to overwrite with the depth of each mean (in metres), or −1.
            drawing: blocks to render, or None for the full image.
        """
        count, channels = features.shape
        width, height, (tiles_x, tiles_y) = camera.width, camera.height, tile_grid(camera)
        if depth_channel >= 0:
            features[:, depth_channel] = 0
        splats, rects, counts = self.project(means, factors, opacities, features, camera)
        if depth_channel >= 0:
            features[:, depth_channel] = splats[:, projection.DEPTH]
        drawing = drawing or self._whole(tiles_x * tiles_y, count)
        self.outside_region, self.drawn, learnt = False, drawing.blocks, drawing.learnt
        if drawing.mask_to_region:
            marks = np.zeros(tiles_x * tiles_y, np.uint64)
            tiles.mark_blocks(splats, rects, learnt, tiles_x, marks)
            self.outside_region, self.drawn = bool((marks & ~drawing.blocks).any()), marks & drawing.blocks
        visible, order = tiles.depth_order(
            splats, counts, self._buffer("keys", (count,), np.uint32), self._buffer("order", (count,), np.int32),
            self._buffer("keys_too", (count,), np.uint32), self._buffer("order_too", (count,), np.int32),
            self._histogram,
        )  # fmt: skip
        tasks = threads()
        begins, ends = self._buffer("begins", (2, tasks), np.int64)
        shares = self._buffer("shares", (tasks + 1,), np.int64)
        # One extra element, because pairs that do not intersect are also written, and then overwritten.
        most = tiles.share_pairs(order, visible, counts, shares, begins) + 1
        firsts = self._buffer("firsts", (count,), np.int64)
        pairs = self._buffer("pairs", (most, 2), np.int32)
        pair_covers = self._buffer("pair_covers", (most,), np.uint64)
        tile_counts = self._buffer("tile_counts", (tasks, tiles_x * tiles_y), np.int32)
        left = tiles.cover_tiles(
            splats, rects, order, visible, tiles_x, self.drawn, learnt, shares, begins, ends, counts, firsts, pairs,
            pair_covers, tile_counts,
        )  # fmt: skip
        self.outside_region |= left > 0
        starts = self._buffer("starts", (tiles_x * tiles_y + 1,), np.int64)
        cursors = self._buffer("cursors", (tasks, tiles_x * tiles_y), np.int64)
        entries = tiles.tile_offsets(tile_counts, starts, cursors)
        items = self._buffer("items", (entries,), np.int32)
        slots = self._buffer("slots", (entries,), np.int32)
        covers = self._buffer("covers", (entries,), np.uint64)
        tiles.fill_tiles(begins, ends, pairs, pair_covers, cursors, items, slots, covers)
        drawn = np.flatnonzero(self.drawn)
        order_of_drawn, tile_shares = balance.distribute(starts[drawn + 1] - starts[drawn] + TILE_COST, tasks)
        tile_order = drawn[order_of_drawn]
        image = self._buffer("image", (channels, tiles_y * TILE, tiles_x * TILE))
        transmittance = self._buffer("transmittance", (tiles_y * TILE, tiles_x * TILE))
        blend_kernels.blend(
            splats, features, (0,) * (channels // blend_kernels.GROUP), starts, items, covers, self.drawn,
            tile_order, tile_shares, (width, height), background, self.limits, image, transmittance,
        )  # fmt: skip
        self._last = ForwardPass(
            means, factors, features, camera, depth_channel, splats, counts, firsts, starts, items, slots, covers,
            learnt, tile_order, tile_shares, image, transmittance, most,
        )  # fmt: skip
        return self.picture

    def _whole(self, tile_count: int, count: int) -> Drawing:
        """Returns a ``Drawing`` that selects all blocks and computes gradients for every Gaussian."""
        blocks, learnt = self._buffer("blocks", (tile_count,), np.uint64), self._buffer("learnt", (count,), np.uint8)
        blocks[:], learnt[:] = np.uint64(2**64 - 1), 1
        return Drawing(blocks, learnt)

    def gradient_buffers(self) -> tuple[Array, Array]:
        """Returns the buffers for dL/dimage [C, rows, stride] and dL/dalpha [rows, stride] that ``backward`` reads.

        Like the forward buffers, these buffers are padded to whole tiles, and the padding must remain zero. They are
        set to zero whenever the image size changes.
        """
        camera, image, transmittance = self._last.camera, self._last.image, self._last.transmittance
        g_image = self._buffer("g_image", image.shape)
        g_alpha = self._buffer("g_alpha", transmittance.shape)
        # Images of different sizes can have the same number of tiles, so old gradients would remain in the padding.
        shape = (len(image), camera.height, camera.width)
        if self._gradient_shape != shape:
            g_image[:] = 0
            g_alpha[:] = 0
            self._gradient_shape = shape
        return g_image, g_alpha

    def backward(
        self,
        g_image: Array,
        g_alpha: Array,
        detached: int = -1,
        within: tuple[NDArray[np.int64], Gradients] | None = None,
    ) -> Gradients:
        """Backpropagates the gradients of a loss through the last forward pass.

        Args:
            g_image, g_alpha: filled buffers from ``gradient_buffers``.
            detached: channel whose gradient propagates to the features but not to the geometry, or −1. This channel of
                the rendered image is set to zero.
            within: gradients of more Gaussians to write to, and the rows of the rendered Gaussians there. By default,
                the gradients are buffers for the rendered Gaussians.
        """
        last = self._last
        features, image = last.features, last.image
        if detached >= 0:
            # A zero channel contributes nothing to the geometry, and its feature gradient does not depend on its value.
            features = features.copy()
            features[:, detached] = 0
            image[detached] = 0
        count, channels = features.shape
        records = self._buffer("records", (last.pairs, blend_kernels.record_columns(channels)))
        blend_kernels.blend_backward(
            last.splats, features, (0,) * (channels // blend_kernels.GROUP), last.starts, last.items, last.slots,
            last.covers, last.learnt, last.tile_order, last.shares, (last.camera.width, last.camera.height),
            self.limits, image, last.transmittance, g_image, g_alpha, records,
        )  # fmt: skip
        rows, gradients = within or (np.arange(count), self._gradient_buffers(count, channels))
        shape = (-(-count // projection.CHUNK), len(projection.COUNTED_GUARDS_BACKWARD))
        guard_counts = self._buffer("guard_counts_backward", shape, np.int64)
        projection.project_backward(
            last.means, last.factors, last.camera.pose, last.camera.lens, self.limits, last.splats,
            last.counts * last.learnt, last.firsts, records, last.depth_channel, rows, *gradients, guard_counts,
        )  # fmt: skip
        self.guards.add(projection.COUNTED_GUARDS_BACKWARD, guard_counts)
        return gradients

    def _gradient_buffers(self, count: int, channels: int) -> Gradients:
        return Gradients(
            self._buffer("g_means", (count, 3)),
            self._buffer("g_factors", (count, 3, 3)),
            self._buffer("g_opacities", (count,)),
            self._buffer("g_features", (count, channels)),
            self._buffer("g_screen", (count, 2)),
        )

    def feature_gradients(self, g_image: Array) -> Array:
        """Returns the feature gradients [N, 4] without computing other gradients. The image must have four channels."""
        last, count = self._last, len(self._last.features)
        records = self._buffer("records", (last.pairs, blend_kernels.record_columns(blend_kernels.GROUP)))
        feature_gradients.blend_features(
            last.splats, last.starts, last.items, last.slots, last.covers, last.learnt, last.tile_order, last.shares,
            (last.camera.width, last.camera.height), self.limits, g_image, records,
        )  # fmt: skip
        gradients = self._buffer("g_features", (count, blend_kernels.GROUP))
        shape = (-(-count // projection.CHUNK), len(projection.COUNTED_GUARDS_BACKWARD))
        guard_counts = self._buffer("guard_counts_backward", shape, np.int64)
        feature_gradients.sum_features(last.counts * last.learnt, last.firsts, records, gradients, guard_counts)
        self.guards.add(projection.COUNTED_GUARDS_BACKWARD, guard_counts)
        return gradients

    def pairs_per_pixel(self) -> Array:
        """Returns the number of Gaussians [H, W] that the last forward pass blended into each pixel."""
        last = self._last
        height, width = last.camera.height, last.camera.width
        pairs = self._buffer("pairs_per_pixel", last.transmittance.shape)
        pair_kernels.count_pairs(
            last.splats, last.starts, last.items, last.covers, last.tile_order, last.shares, (width, height),
            self.limits, pairs,
        )  # fmt: skip
        return pairs[:height, :width]

    @property
    def planes(self) -> Array:
        """Image [C, rows, stride] of the last forward pass, padded to whole tiles."""
        return self._last.image

    @property
    def picture(self) -> Picture:
        """Result of the last forward pass, valid until the next one."""
        height, width = self._last.camera.height, self._last.camera.width
        return Picture(self._last.image[:, :height, :width], self._last.transmittance[:height, :width])

    @property
    def splats(self) -> Array:
        """Splats [N, 16] of the last forward pass. See ``kernels.projection`` for the columns."""
        return self._last.splats

    @property
    def counts(self) -> NDArray[np.int32]:
        """Number [N] of tiles covered by each Gaussian in the last forward pass. It is 0 for culled Gaussians."""
        return self._last.counts
