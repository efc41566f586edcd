"""Incremental rendering and loss of the pixels covered by moving Gaussians, used while static Gaussians are fixed.

Moving Gaussians only affect the blocks (4×4 pixels) that their supports intersect. In these blocks, all intersecting
Gaussians, both moving and static, are rendered in the same order as in the full image. Pixels and gradients are
therefore bit-identical to those of a full rendering. All other pixels show only static Gaussians, and are re-rendered
only when the static Gaussians change.

Candidate blocks and their static Gaussians are determined once per frame and view, around the moving Gaussians. The
blocks to render are determined in every iteration. The image loss is evaluated near all candidate blocks. The loss of
the rest of the image is constant during a frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.cpu.blocks import pixels_of, tile_grid, widened
from scas4d_core.engines.cpu.gloss import features_seen
from scas4d_core.engines.cpu.rasterizer import Drawing
from scas4d_core.engines.cpu.renderer import CpuRenderer, blocks_of, forget_moments, no_lap
from scas4d_core.engines.limits import DEFAULT, Limits
from scas4d_core.engines.renderer import Gradients, Picture, psnr_of
from scas4d_core.engines.views import LABEL, CameraArrays, TrainingView, means
from scas4d_core.gaussians import Gaussians
from scas4d_core.kernels import image_loss, lanes, tiles
from scas4d_core.kernels.box_loss import box_loss

Array = NDArray[np.float32]
Doubles = NDArray[np.float64]
State = tuple[Array, Array, Array, Array]

MARGIN = 2
"""Margin, in blocks, that is added around the initial extent of the moving Gaussians to allow for further motion."""
REACH = 2 * image_loss.REACH
"""Distance in pixels within which the gradient depends on the image: twice the radius of the SSIM window."""
MOST = 0.6
"""Fraction of moving Gaussians above which rendering full images is cheaper, because few Gaussians are static."""


@dataclass(eq=False)
class Region:
    """The part of one camera's image that may be rendered in a frame.

    Attributes:
        blocks: [tiles] uint64 bitmask of the candidate blocks. Each rendering includes only the blocks that
            moving Gaussians cover.
        rows: [R] int64 rows of the rendered Gaussians, in ascending order.
        learnt: [R] uint8 mask of the moving Gaussians in ``rows``.
        moving: [M] int64 indices of the moving Gaussians in ``rows``.
        box: image rows and columns that contain the blocks plus a margin of ``REACH``.
        near: [h, columns] uint8 flags of the losses in the box that can change, as in ``image_loss.near``. All
            other losses are included in ``outside_losses``.
        view: view to which the following fields belong, or None if no view is loaded yet.
        target: [C, h, w] crop of the view's target.
        moments: crops of the target's two SSIM moments, each with the same shape as ``target``.
        outside_losses: image loss, mask loss and squared error of the constant part of the image.
    """

    blocks: NDArray[np.uint64]
    rows: NDArray[np.int64]
    learnt: NDArray[np.uint8]
    moving: NDArray[np.int64]
    box: tuple[slice, slice]
    near: NDArray[np.uint8]
    view: TrainingView | None = None
    target: Array = field(default_factory=lambda: np.empty((0, 0, 0), np.float32))
    moments: tuple[Array, Array] = ()  # type: ignore[assignment]
    outside_losses: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))


class ChangedPixels(CpuRenderer):
    """A ``CpuRenderer`` for states in which only the moving Gaussians change between calls to ``load_state``.

    The gradients of static Gaussians are 0.

    Args:
        background, image_weight, mask_weight, limits: see ``CpuRenderer``.
        moving: [M] int64 rows of the moving Gaussians.
        count: number of Gaussians, N.
    """

    def __init__(
        self,
        background: tuple[float, float, float],
        image_weight: float,
        mask_weight: float,
        moving: NDArray[np.int64],
        count: int,
        limits: Limits = DEFAULT,
    ) -> None:
        super().__init__(background, image_weight, mask_weight, limits=limits)
        self._moving = np.sort(moving)
        self._is_moving = np.zeros(count, bool)
        self._is_moving[moving] = True
        self._static_rows = np.flatnonzero(~self._is_moving)
        self._static_state: State | None = None
        self._static_planes: dict[tuple[str, int, int], Array] = {}
        self._poses: dict[tuple[str, int, int], Array] = {}
        self._static_transmittances: dict[tuple[str, int, int], Array] = {}
        self._static_means: dict[tuple[str, int, int], NDArray[np.float64]] = {}
        self._regions: dict[tuple[str, int, int], Region] = {}
        self._gradients: Gradients | None = None
        self._box_scratch, self._planes = np.empty(0, np.float32), np.empty(0, np.float32)
        self._shown_mean = np.zeros(3)

    def load_state(self, previous: Gaussians) -> None:
        """Loads the initial state of a frame. Static Gaussians are rendered again if they have changed."""
        features = previous.features(previous.colours)
        state = take_rows((previous.means, previous.factors, previous.opacities, features), self._static_rows)
        if self._static_state is None or not all(map(np.array_equal, state, self._static_state)):
            self._static_planes.clear()
            self._regions.clear()
            self._static_state = state

    def forward_backward(
        self,
        means: Array,
        factors: Array,
        opacities: Array,
        features: Array,
        view: TrainingView,
        lap: Callable[[str], None] = no_lap,
    ) -> Gradients:
        """Renders the changed pixels and sets the losses and ``psnr`` of the full image; see ``CpuRenderer``."""
        region = self._render_region((means, factors, opacities, features), view)
        lap("render")
        self._compare_box(region, view)
        lap("picture loss")
        if self._gradients is None or self._gradients.features.shape != features.shape:
            shapes = (means.shape, factors.shape, opacities.shape, features.shape, (len(means), 2))
            self._gradients = Gradients(*(np.zeros(shape, np.float32) for shape in shapes))
        within = region.rows, self._gradients  # the gradients of static Gaussians remain 0
        self.rasterizer.backward(*self.rasterizer.gradient_buffers(), self._detached, within)
        lap("render backward")
        return self._gradients

    def forward(self, means: Array, factors: Array, opacities: Array, features: Array, view: TrainingView) -> None:
        """Same as ``forward_backward``, but does not compute gradients."""
        region = self._render_region((means, factors, opacities, features), view)
        self._compare_box(region, view)

    def residuals(
        self, state: Gaussians, view: TrainingView, learnt: NDArray[np.uint8], most: float
    ) -> tuple[Array, Array]:
        """See ``HostRenderer.residuals``. Renders only changed pixels if ``learnt`` is the moving Gaussians."""
        if not np.array_equal(learnt, self._is_moving):
            return super().residuals(state, view, learnt, most)
        count, shown = len(state), features_seen(state, view.camera)
        region = self._render_region((state.means, state.factors, state.opacities, shown), view)
        sums, weights = np.zeros((count, 3), np.float32), np.zeros(count, np.float32)
        missing = self._lacking(view, most)
        sums[self._moving], weights[self._moving] = missing[0][region.moving], missing[1][region.moving]
        return sums, weights

    def shown(self, view: TrainingView) -> Picture:
        """See ``CpuRenderer.shown``."""
        drawn, shown = self.rasterizer.picture, pixels_of(self.rasterizer.drawn, view.camera)
        whole = Picture(self._static_background(view).copy(), self._static_transmittances[_key(view)].copy())
        for plane, new in zip(
            (*whole.features, whole.transmittance), (*drawn.features, drawn.transmittance), strict=True
        ):
            np.copyto(plane, new, where=shown)
        return whole

    def colour_shift(self, view: TrainingView) -> tuple[float, float, float]:
        """See ``CpuRenderer.colour_shift``."""
        shown = view.exposure[:3, 0] * self._shown_mean + view.exposure[:3, 1]
        red, green, blue = (view.mean - shown).tolist()
        return red, green, blue

    def _render_region(self, state: State, view: TrainingView) -> Region:
        """Renders the region of a view, enlarging it until it contains all moving Gaussians."""
        key = _key(view)
        region = self._regions.get(key)
        if region is None or region.view is not view:
            # The region is rebuilt in every frame, because rounding errors depend on the box and a replay does not
            # process the earlier frames.
            region = self._regions[key] = self._make_region(self._moving_blocks(state, view.camera), view)
        while True:
            part = take_rows(state, region.rows)
            drawing = Drawing(region.blocks, region.learnt, mask_to_region=True)
            self.rasterizer.forward(*part, view.camera, self._background, drawing=drawing)
            if not self.rasterizer.outside_region:
                return region
            region = self._regions[key] = self._make_region(
                self._moving_blocks(state, view.camera) | region.blocks, view
            )

    def _moving_blocks(self, state: State, camera: CameraArrays) -> NDArray[np.uint64]:
        return blocks_of(self.rasterizer, *take_rows(state, self._moving), camera)

    def _make_region(self, marks: NDArray[np.uint64], view: TrainingView) -> Region:
        """Builds a region around the marked blocks, including the static Gaussians that intersect it."""
        assert self._static_state is not None
        blocks, camera = widened(marks, view.camera, MARGIN), view.camera
        splats, rects, _ = self.rasterizer.project(*self._static_state, camera)
        meets = np.empty(len(self._static_rows), bool)
        tiles.find_meeting(splats, rects, tile_grid(camera)[0], blocks, meets)
        rows = np.sort(np.concatenate([self._moving, self._static_rows[meets]]))
        learnt, shown = self._is_moving[rows].astype(np.uint8), pixels_of(blocks, camera)
        box = _box(shown)
        region = Region(blocks, rows, learnt, np.flatnonzero(learnt), box, image_loss.near(shown[box]))
        self._load_view(region, view)
        return region

    def _load_view(self, region: Region, view: TrainingView) -> None:
        """Loads the crops of a view's target into a region, and computes the losses of the rest of the image."""
        base = self._static_background(view)
        where = (slice(None), *region.box)
        region.view, region.target = view, np.ascontiguousarray(view.target[where])
        whole = self._moments(view)
        region.moments = np.ascontiguousarray(whole[0][where]), np.ascontiguousarray(whole[1][where])
        region.outside_losses = self._outside_losses(base, view, whole, region)
        forget_moments(view)  # the region has its own crop

    def _static_background(self, view: TrainingView) -> Array:
        """Returns a rendering [4, H, W] of only the static Gaussians."""
        key = _key(view)
        if key not in self._static_planes or not np.array_equal(self._poses[key], view.camera.pose):
            assert self._static_state is not None
            self._poses[key] = view.camera.pose
            picture = self.rasterizer.forward(*self._static_state, view.camera, self._background)
            self._static_planes[key], self._static_transmittances[key] = (
                picture.features.copy(),
                picture.transmittance.copy(),
            )
            self._static_means[key] = means(self._static_planes[key][:3])
        return self._static_planes[key]

    def _compare_box(self, region: Region, view: TrainingView) -> None:
        """Computes the losses of the rendering, and their gradient in the rendered blocks."""
        base, (rows, columns) = self._static_background(view), region.box
        box = (rows.start, rows.stop, columns.start, columns.stop)
        part, g_part = self._part(len(base), box)
        g_image, _ = self.rasterizer.gradient_buffers()
        (channels, height, width), shifts = region.target.shape, np.zeros(len(base))
        losses, g_exposure = (np.empty((channels, height, 2), np.float32) for _ in range(2))
        box_loss(
            image_loss.bands_of(len(base), height), self.rasterizer.planes, base, self.rasterizer.drawn,
            tile_grid(view.camera)[0], box, part, g_part, g_image, view.exposure, region.target, *region.moments,
            self._weights[:channels], view.camera.height * view.camera.width, self._cleared(channels, height, width),
            region.near, losses, g_exposure, shifts,
        )  # fmt: skip
        sums = region.outside_losses + _totals(losses)
        self.image_part, self.mask_part = float(sums[0]), float(sums[1])
        pixels = view.camera.height * view.camera.width
        self.psnr = psnr_of(float(sums[2]), pixels)
        self._shown_mean = self._static_means[_key(view)] + shifts[:3] / pixels

    def _part(self, channels: int, box: tuple[int, int, int, int]) -> tuple[Array, Array]:
        """Returns two [C, h, w] buffers for a box: one for the rendering, and one for the gradient."""
        shape = (2, channels, box[1] - box[0], box[3] - box[2])
        if self._planes.size < (size := int(np.prod(shape))):
            self._planes = np.empty(size + size // 4, np.float32)
        part, g_part = self._planes[:size].reshape(shape)
        return part, g_part

    def _outside_losses(self, base: Array, view: TrainingView, moments: tuple[Array, Array], region: Region) -> Doubles:
        """Returns the sums of ``_totals`` over the part of an image that is constant during a frame."""
        channels, height, width = view.target.shape
        losses, g_exposure = (np.empty((channels, height, 2), np.float32) for _ in range(2))
        wanted = _outside_region(region.box, region.near, height, width)  # requests no gradient
        image_loss.image_loss(
            image_loss.bands_of(channels, height), base, view.exposure, view.target, *moments,
            self._weights[:channels], height * width, self._cleared(channels, height, width), wanted, base, losses,
            g_exposure,
        )  # fmt: skip
        return _totals(losses)

    def _cleared(self, channels: int, height: int, width: int) -> Array:
        """Returns the scratch buffer of the image loss for a box, with its border rows set to zero."""
        shape = (6, channels, height + 2 * image_loss.REACH, image_loss.stride(width))
        size = int(np.prod(shape))
        if self._box_scratch.size < size:
            self._box_scratch = np.empty(size + size // 4, np.float32)
        scratch: Array = self._box_scratch[:size].reshape(shape)
        scratch[:, :, : image_loss.REACH] = 0
        scratch[:, :, -image_loss.REACH :] = 0
        return scratch


def _totals(losses: Array) -> Doubles:
    """Returns the image loss, mask loss and squared error of an image, given the losses [C, H, 2] of its rows."""
    sums = losses.sum(axis=1, dtype=np.float64)
    return np.array([sums[:3, 0].sum(), sums[LABEL:, 0].sum(), sums[:3, 1].sum()])


def take_rows(state: State, rows: NDArray[np.int64]) -> State:
    """Returns the given rows of all arrays of a state."""
    one, two, three, four = (np.take(array, rows, axis=0) for array in state)
    return one, two, three, four


def _key(view: TrainingView) -> tuple[str, int, int]:
    """Returns a view's camera name and image size. Probe views use the same cameras at a lower resolution."""
    return view.name, view.camera.width, view.camera.height


def _box(shown: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Returns a box around the given pixels that contains the windows of all losses affected by these pixels.

    If no pixels are marked, the box is a single pixel. The first column is a multiple of sixteen, which aligns
    the flags of ``image_loss.near`` with those of the full image.
    """
    rows, columns = np.flatnonzero(shown.any(axis=1)), np.flatnonzero(shown.any(axis=0))
    if len(rows) == 0:
        return slice(0, 1), slice(0, 1)
    height, width = shown.shape
    left, right = max(0, columns[0] - image_loss.REACH), columns[-1] + 1 + image_loss.REACH
    return (
        slice(max(0, rows[0] - REACH), min(height, rows[-1] + 1 + REACH)),
        slice(
            max(0, left // lanes.COUNT - 1) * lanes.COUNT,
            min(width, image_loss.stride(right) + image_loss.REACH),
        ),
    )


def _outside_region(box: tuple[slice, slice], near: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    """Returns [height, columns] uint8 flags of the losses outside a region; see ``image_loss.image_loss``.

    Args:
        box, near: the corresponding fields of ``Region``.
        height, width: image size in pixels.
    """
    wanted = np.full((height, image_loss.stride(width) // lanes.COUNT), image_loss.LOSSES)
    rows, first = box[0], box[1].start // lanes.COUNT
    here = wanted[rows, first : first + near.shape[1]]
    here[near & image_loss.LOSS != 0] &= ~image_loss.LOSS
    return wanted
