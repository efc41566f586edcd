"""Rasterizer, which launches the kernels that render an image and backpropagate its gradient, and owns their buffers.

Except for ``resize`` and ``grow``, no method waits for the device or allocates memory, so all other methods can be
captured in a CUDA graph.
"""

from __future__ import annotations

import warp as wp

from scas4d_core.engines.limits import DEFAULT, Limits
from scas4d_core.engines.renderer import CHANNELS
from scas4d_core.engines.warp import blend, projection, tiles
from scas4d_core.engines.warp.lanes import lanes_of
from scas4d_core.engines.warp.layout import PIXELS, SEGMENT, TILE, raster_of

LEAST_CAPACITY = 1 << 16
"""Minimum initial capacity of the tile lists, in entries."""
TILES_EACH = 8
"""Initial tile-list capacity per Gaussian. On average, a Gaussian intersects two to four tiles."""
WARPS_EACH = 24
"""Number of warps per multiprocessor that blend segments. More warps would need too many registers."""


class Rasterizer:
    """Rasterizer for images of a fixed number of Gaussians.

    Args:
        device: Warp device, such as "cpu" or "cuda:0".
        count: number of Gaussians.
        limits: rasterizer constants.
        detached: whether the label channel's gradient only affects the labels.

    Attributes:
        count: number of Gaussians; see ``draw_fewer``.
        planes: [5, rows, columns] last image: four features including the background, and remaining transmittance.
        g_planes: [4, rows, columns] gradient of the features, which ``carry_back`` reads.
        splats: [2 N] vec4 splats; see ``supports``.
        records: [4 N] vec4 gradient records; see ``projection``.
        starts: [tiles + 1] first entry of each tile list of the last image.
        items: [capacity] Gaussian of each tile-list entry.
        tiles_x: number of tile columns.
        guard_counts: [3] number of times each guard in ``projection.COUNTED_GUARDS`` was triggered.
        capacity: maximum number of tile-list entries. An image that needs more is rendered empty (see ``grow``).
    """

    def __init__(self, device: str, count: int, limits: Limits = DEFAULT, detached: bool = False) -> None:
        self._device, self.count, self._limits, self._detached = device, count, limits, detached
        self._lanes = lanes_of(device)
        self._warps = max(1, WARPS_EACH * wp.get_device(device).sm_count)
        self._columns = self._rows = 0
        self.capacity = max(LEAST_CAPACITY, TILES_EACH * count)
        self.splats = wp.zeros(2 * count, dtype=wp.vec4, device=device)
        self.records = wp.zeros(projection.RECORD * count, dtype=wp.vec4, device=device)
        self._boxes = wp.zeros(count, dtype=wp.vec4i, device=device)
        self.guard_counts = wp.zeros(len(projection.COUNTED_GUARDS), dtype=wp.int32, device=device)

    def resize(self, columns: int, rows: int) -> None:
        """Allocates buffers for images of the given size, and for ``capacity`` tile-list entries."""
        device = self._device
        self._columns = self._rows = 0  # if memory is full, the buffers hold no image
        self._raster = raster_of(self._limits, self.count, columns, rows, self.capacity, self._detached)
        self.tiles_x = -(-columns // TILE)
        self._tiles = self.tiles_x * -(-rows // TILE)
        segments = self.capacity // SEGMENT + self._tiles
        self.planes = wp.zeros((CHANNELS + 1, rows, columns), dtype=wp.float32, device=device)
        self.g_planes = wp.zeros((CHANNELS, rows, columns), dtype=wp.float32, device=device)
        self._begun = wp.zeros((rows, columns), dtype=wp.int32, device=device)
        self._tile_counts = wp.zeros(self._tiles, dtype=wp.int32, device=device)
        self.starts = wp.zeros(self._tiles + 1, dtype=wp.int32, device=device)
        self._segment_starts = wp.zeros(self._tiles + 1, dtype=wp.int32, device=device)
        self._segment_tiles = wp.zeros(segments, dtype=wp.int32, device=device)
        self._segment_light = wp.zeros(segments * PIXELS, dtype=wp.float32, device=device)
        self._segment_features = wp.zeros(segments * PIXELS, dtype=wp.vec4, device=device)
        self._keys = wp.zeros(self.capacity, dtype=wp.uint64, device=device)
        self.items = wp.zeros(self.capacity, dtype=wp.int32, device=device)
        self._columns, self._rows = columns, rows

    def draw_fewer(self, count: int) -> None:
        """Sets the number of Gaussians to render, which must not exceed the size of the buffers."""
        self.count = self._raster.count = count

    def holds(self, columns: int, rows: int) -> bool:
        """Returns whether images of the given size fit into the buffers."""
        return columns <= self._columns and rows <= self._rows

    def grow(self, room: float) -> bool:
        """Enlarges the tile lists if an image needs more entries.

        Args:
            room: largest value in the log column ``layout.PAIRS``.

        Returns:
            Whether buffers were reallocated, which invalidates captured graphs.
        """
        if room <= self.capacity:
            return False
        self.capacity = int(room)
        self.resize(self._columns, self._rows)
        return True

    def project(
        self, cameras: wp.array, view: wp.array, means: wp.array, factors: wp.array, opacities: wp.array,
        features: wp.array, record: wp.array, log: wp.array,
    ) -> None:  # fmt: skip
        """Projects the Gaussians and builds the tile lists.

        Args:
            cameras: [views] cameras of all views, of type ``Camera``.
            view: [1] index of the view.
            means, factors, opacities, features: [N] arrays of type vec3, mat33, float32 and vec4, respectively.
            record: [1] row of the log.
            log: [records, 8] log. The row is reset to 0, except for the column ``PAIRS``, which is set.
        """
        device, view_of = self._device, [cameras, view]
        count = -(-self.count // self._lanes) * self._lanes
        given = [means, factors, opacities, features]
        out = [self.splats, self._boxes, self.records, self.guard_counts, self._tile_counts, self.starts, self._keys]
        wp.launch(projection.project, count, [self._raster, *view_of, *given, *out], device=device)
        threads = tiles.SCAN_BLOCK if self._lanes > 1 else 1
        lists = [self.starts, self._segment_starts, record, log]
        wp.launch(
            tiles.place_lists, threads, [threads, self._raster, self._tile_counts, *lists], device=device,
            block_dim=tiles.SCAN_BLOCK,
        )  # fmt: skip
        splats = [self.splats, self._boxes, self.starts, self._tile_counts, self._keys]
        wp.launch(tiles.fill_lists, count, [self._raster, *view_of, *splats], device=device)
        threads = tiles.SORT_BLOCK if self._lanes > 1 else 1
        lists = [self.starts, self._segment_starts, self._tile_counts, self._keys, self.items, self._segment_tiles]
        wp.launch(tiles.sort_lists, self._tiles * threads, [threads, *lists], device=device, block_dim=tiles.SORT_BLOCK)

    def draw(self, cameras: wp.array, view: wp.array, features: wp.array, background: wp.array) -> None:
        """Renders the projected Gaussians.

        Args:
            cameras, view: see ``project``.
            features: [N] vec4 features.
            background: [1] vec4 background features.
        """
        given = [self._raster, cameras, view, self.splats, features, self.items, self.starts, self._segment_starts]
        state = [self._segment_light, self._segment_features]
        inputs = [*given, self._segment_tiles, self._warps, *state]
        wp.launch(blend.blend_segments, self._warps * self._lanes, inputs, device=self._device, block_dim=PIXELS)
        inputs = [*given, background, *state, self._begun, self.planes]
        wp.launch(blend.join_segments, self._tiles * PIXELS, inputs, device=self._device, block_dim=PIXELS)

    def count_pairs(self, every: int, pairs: wp.array) -> None:
        """Counts the projected Gaussians that are blended into pixels; see ``blend.count_pairs``."""
        inputs = [self._raster, self.splats, self.items, self.starts, every, pairs]
        wp.launch(blend.count_pairs, pairs.shape, inputs, device=self._device)

    def carry_back(self, cameras: wp.array, view: wp.array, features: wp.array) -> None:
        """Backpropagates ``g_planes`` to ``records``. See ``draw`` for the arguments."""
        given = [self._raster, cameras, view, self.splats, features, self.items, self.starts, self._segment_starts]
        state = [self._segment_light, self._segment_features, self._begun, self.planes, self.g_planes, self.records]
        inputs = [*given, self._segment_tiles, self._warps, *state]
        wp.launch(blend.blend_backward, self._warps * self._lanes, inputs, device=self._device, block_dim=PIXELS)

    def carry_to_world(
        self, cameras: wp.array, view: wp.array, means: wp.array, factors: wp.array, g_means: wp.array,
        g_factors: wp.array, g_features: wp.array, *, add: bool = True,
    ) -> None:  # fmt: skip
        """Computes the gradients of the Gaussians from ``records``.

        Args:
            cameras, view, means, factors: see ``project``.
            g_means, g_factors, g_features: [N] outputs of type vec3, mat33 and vec4, respectively.
            add: whether to add to the outputs instead of overwriting them.
        """
        given = [self._raster, cameras, view, means, factors, self.splats, self.records, self.guard_counts]
        inputs = [*given, int(add), g_means, g_factors, g_features]
        wp.launch(projection.project_backward, self.count, inputs, device=self._device)

    def mark(self, cameras: wp.array, side: int, features: wp.array, marks: wp.array) -> None:
        """Marks the ``side``-pixel blocks that projected moving Gaussians intersect; see ``tiles.mark_blocks``."""
        inputs = [side, cameras, features, self.splats, self._boxes, marks]
        wp.launch(tiles.mark_blocks, self.count, inputs, device=self._device)
