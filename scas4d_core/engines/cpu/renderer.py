"""CPU renderer, which renders states, compares them with training images and backpropagates image and mask losses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.cpu.blocks import as_grid, tile_grid
from scas4d_core.engines.cpu.gloss import features_seen
from scas4d_core.engines.cpu.rasterizer import CpuRasterizer, Drawing
from scas4d_core.engines.host_renderer import HostRenderer
from scas4d_core.engines.limits import DEFAULT, Limits
from scas4d_core.engines.renderer import (
    CHANNELS,
    Comparison,
    Gradients,
    Picture,
    psnr_of,
)
from scas4d_core.engines.views import LABEL, CameraArrays, TrainingView, means
from scas4d_core.gaussians import Gaussians
from scas4d_core.kernels import image_loss, tiles

Array = NDArray[np.float32]
Moments = tuple[Array, Array]

_moments: WeakKeyDictionary[TrainingView, Moments] = WeakKeyDictionary()
"""SSIM moments of each view (windowed means of the target and of its square), shared by all renderers."""


def no_lap(stage: str) -> None:
    """Default ``lap`` callback, which does nothing."""


class CpuRenderer(HostRenderer):
    """The CPU implementation of ``Renderer``, which also computes the image and mask losses of iterations.

    Args:
        background: background colour, RGB in [0, 1].
        image_weight, mask_weight: weights of the image and mask losses.
        mask_moves: whether the mask loss affects positions and shapes in addition to the labels. Masks have hard
            edges, so silhouettes fitted to masks differ from silhouettes fitted to images.
        limits: rasterizer constants.

    Attributes:
        rasterizer: rasterizer that contains the results of the last rendering.
        image_part, mask_part: weighted image and mask losses of the last comparison.
        psnr: PSNR of the last comparison, in dB.
        exposure_gradient: [C, 2] gradient of the last loss with respect to the camera's gain and offset.
    """

    def __init__(
        self,
        background: tuple[float, float, float],
        image_weight: float = 1.0,
        mask_weight: float = 0.0,
        mask_moves: bool = True,
        limits: Limits = DEFAULT,
    ) -> None:
        self.rasterizer = CpuRasterizer(limits)
        self._detached = -1 if mask_moves else LABEL
        self._background = np.array([*background, 0.0], np.float32)
        self._weights = np.array([image_weight / 3] * 3 + [mask_weight], np.float32)
        self._scratch: dict[tuple[int, int, int], Array] = {}
        self.exposure_gradient = np.zeros((CHANNELS, 2), np.float32)
        self.image_part = 0.0
        self.mask_part = 0.0
        self.psnr = 0.0

    def with_new_buffers(self, mask_weight: float) -> CpuRenderer:
        """Returns a full-image renderer with the same background and limits, whose mask loss only affects labels."""
        red, green, blue, _ = self._background.tolist()
        limits = Limits(*self.rasterizer.limits.tolist())
        return CpuRenderer((red, green, blue), 1.0, mask_weight, mask_weight == 0, limits)

    # Implementation of ``Renderer``, for rendering states.

    def render(
        self,
        state: Gaussians,
        camera: CameraArrays,
        features: Array | None = None,
        *,
        depth_channel: int = -1,
        background: Array | None = None,
    ) -> Picture:
        """See ``Renderer.render``."""
        shown = features_seen(state, camera) if features is None else features
        if background is None:
            background = np.zeros(shown.shape[1], np.float32)
            background[:CHANNELS] = self._background
        given = (state.means, state.factors, state.opacities, shown, camera, background)
        return self.rasterizer.forward(*given, depth_channel)

    def compare(self, state: Gaussians, views: Sequence[TrainingView]) -> list[Comparison]:
        """See ``Renderer.compare``."""
        compared = []
        for view in views:
            self.forward(state.means, state.factors, state.opacities, features_seen(state, view.camera), view)
            compared.append(Comparison(self.psnr, self.image_part, self.colour_shift(view)))
        return compared

    def gather(self, state: Gaussians, camera: CameraArrays, planes: Array) -> Array:
        """See ``Renderer.gather``."""
        self.render(state, camera, state.features(state.colours))
        g_image, _ = self.rasterizer.gradient_buffers()
        g_image[:] = 0
        g_image[: len(planes), : camera.height, : camera.width] = planes
        sums = self.rasterizer.feature_gradients(g_image)[:, : len(planes)].copy()
        g_image[:] = 0
        return sums

    def residuals(
        self, state: Gaussians, view: TrainingView, learnt: NDArray[np.uint8], most: float
    ) -> tuple[Array, Array]:
        """See ``HostRenderer.residuals``."""
        tiles_x, tiles_y = tile_grid(view.camera)
        drawing = Drawing(np.full(tiles_x * tiles_y, 2**64 - 1, np.uint64), learnt)
        shown = features_seen(state, view.camera)
        given = (state.means, state.factors, state.opacities, shown, view.camera, self._background)
        self.rasterizer.forward(*given, drawing=drawing)
        return self._lacking(view, most)

    def reached(self, state: Gaussians, cameras: Sequence[CameraArrays]) -> list[NDArray[np.bool_]]:
        """See ``Renderer.reached``."""
        rows = np.flatnonzero(state.moving)
        means, factors, opacities = (
            np.take(each, rows, axis=0) for each in (state.means, state.factors, state.opacities)
        )
        moving = means, factors, opacities, np.zeros((len(rows), CHANNELS), np.float32)
        return [as_grid(blocks_of(self.rasterizer, *moving, camera), camera) for camera in cameras]

    def pairs_per_pixel(
        self, state: Gaussians, cameras: Sequence[CameraArrays], every: int = 1
    ) -> list[NDArray[np.int32]]:
        """See ``Renderer.pairs_per_pixel``."""
        counted = []
        for camera in cameras:
            self.render(state, camera, state.features(state.colours))
            counted.append(self.rasterizer.pairs_per_pixel()[::every, ::every].astype(np.int32))
        return counted

    # Losses of iterations, for arrays that are updated in place.

    def load_state(self, previous: Gaussians) -> None:
        """Loads the initial state of a frame. This class ignores the state, but subclasses may use it."""

    def forward_backward(
        self,
        means: Array,
        factors: Array,
        opacities: Array,
        features: Array,
        view: TrainingView,
        lap: Callable[[str], None] = no_lap,
    ) -> Gradients:
        """Renders a view, sets ``image_part``, ``mask_part`` and ``psnr``, and returns the gradients.

        The gradients are buffers that stay valid until the next call.

        Args:
            means: [N, 3] float32 means, in metres.
            factors: [N, 3, 3] float32 covariance factors.
            opacities: [N] float32 opacities.
            features: [N, 4] float32 features (RGB, label).
            view: view to render and compare.
            lap: callback that receives the name of each stage when the stage ends.
        """
        self.rasterizer.forward(means, factors, opacities, features, view.camera, self._background)
        lap("render")
        g_image, g_alpha = self.rasterizer.gradient_buffers()
        self._compare(view, g_image)
        lap("picture loss")
        gradients = self.rasterizer.backward(g_image, g_alpha, self._detached)
        lap("render backward")
        return gradients

    def forward(self, means: Array, factors: Array, opacities: Array, features: Array, view: TrainingView) -> None:
        """Renders a view and sets ``image_part``, ``mask_part`` and ``psnr``, without computing gradients.

        See ``forward_backward`` for the arguments.
        """
        self.rasterizer.forward(means, factors, opacities, features, view.camera, self._background)
        g_image, _ = self.rasterizer.gradient_buffers()
        self._compare(view, g_image)

    def shown(self, view: TrainingView) -> Picture:
        """Returns the full image of the view last passed to ``forward_backward``, valid until the next rendering."""
        return self.rasterizer.picture

    def colour_shift(self, view: TrainingView) -> tuple[float, float, float]:
        """Returns the view's mean colour minus that of its last rendering with exposure applied, RGB in [0, 1]."""
        height, width = view.camera.height, view.camera.width
        rendered = means(self.rasterizer.planes[:3, :height, :width])
        shown = view.exposure[:3, 0] * rendered + view.exposure[:3, 1]
        red, green, blue = (view.mean - shown).tolist()
        return red, green, blue

    def _compare(self, view: TrainingView, g_image: Array) -> None:
        """Computes the losses of the last rendering, and fills ``g_image`` with their gradient."""
        channels, height, width = view.target.shape
        rows = np.empty((channels, height, 2), np.float32)
        g_exposure = np.empty((channels, height, 2), np.float32)
        image_loss.image_loss(
            image_loss.bands_of(channels, height), self.rasterizer.planes, view.exposure, view.target,
            *self._moments(view), self._weights[:channels], height * width, self._scratch_of(channels, height, width),
            image_loss.EVERYWHERE, g_image, rows, g_exposure,
        )  # fmt: skip
        g_image[channels:] = 0
        sums = rows.sum(axis=1, dtype=np.float64)
        self.image_part, self.mask_part = float(sums[:3, 0].sum()), float(sums[3:, 0].sum())
        self.psnr = psnr_of(float(sums[:3, 1].sum()), height * width)
        self.exposure_gradient[:channels] = g_exposure.sum(axis=1)

    def _lacking(self, view: TrainingView, most: float) -> tuple[Array, Array]:
        """Returns the sums of ``HostRenderer.residuals`` for the last rendering."""
        height, width = view.camera.height, view.camera.width
        g_image, _ = self.rasterizer.gradient_buffers()
        gain, offset = view.exposure[:3, :1, None], view.exposure[:3, 1:, None]
        here = (slice(None, 3), slice(height), slice(width))
        g_image[here] = np.clip((view.target[:3] - offset) / gain - self.rasterizer.planes[here], -most, most)
        g_image[LABEL, :height, :width] = 1
        sums = self.rasterizer.feature_gradients(g_image)
        return sums[:, :3].copy(), sums[:, LABEL].copy()

    def _moments(self, view: TrainingView) -> Moments:
        """Returns the SSIM moments of a view: windowed means of the target and of its square, [C, H, W] each."""
        moments = _moments.get(view)
        if moments is None:
            moments = np.empty_like(view.target), np.empty_like(view.target)
            image_loss.target_moments(view.target, self._scratch_of(*view.target.shape), *moments)
            _moments[view] = moments
        return moments

    def _scratch_of(self, channels: int, height: int, width: int) -> Array:
        """Returns the zero-padded scratch buffer of the image loss for an image size."""
        key = (channels, height, width)
        if key not in self._scratch:
            padded = (6, channels, height + 2 * image_loss.REACH, image_loss.stride(width))
            self._scratch[key] = np.zeros(padded, np.float32)
        return self._scratch[key]


def forget_moments(view: TrainingView) -> None:
    """Drops a view's cached moments. Call this function after the renderer has copied the part that it needs."""
    _moments.pop(view, None)


def blocks_of(
    rasterizer: CpuRasterizer, means: Array, factors: Array, opacities: Array, features: Array, camera: CameraArrays
) -> NDArray[np.uint64]:
    """Returns the bitmask [tiles] of the image blocks that the supports of the Gaussians intersect."""
    splats, rects, _ = rasterizer.project(means, factors, opacities, features, camera)
    tiles_x, tiles_y = tile_grid(camera)
    marks = np.zeros(tiles_x * tiles_y, np.uint64)
    tiles.mark_blocks(splats, rects, np.ones(len(rects), np.uint8), tiles_x, marks)
    return marks
