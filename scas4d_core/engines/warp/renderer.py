"""GPU renderer, which renders states with the kernels of the Warp engine."""

from __future__ import annotations

import numpy as np
import warp as wp
from numpy.typing import NDArray

from scas4d_core.engines.cpu.gloss import features_seen
from scas4d_core.engines.limits import DEFAULT, Limits
from scas4d_core.engines.renderer import BLOCK, CHANNELS, Comparison, Picture, psnr_of
from scas4d_core.engines.views import LABEL, CameraArrays, TrainingView
from scas4d_core.engines.warp.layout import COLUMNS, IMAGE_LOSS, PAIRS, SHIFT, SQUARES, Camera, camera_of
from scas4d_core.engines.warp.picture_loss import PictureLoss
from scas4d_core.engines.warp.projection import FEATURES, RECORD
from scas4d_core.engines.warp.rasterizer import Rasterizer
from scas4d_core.gaussians import Gaussians
from scas4d_core.guards import FEATURE_CEILING

Array = NDArray[np.float32]
PADDING = 32
"""Tile size in pixels. ``reached`` pads images to a multiple of this size."""


class WarpRenderer:
    """The ``Renderer`` implementation in NVIDIA Warp. Each call uploads a state and waits for the result.

    Args:
        background: background colour, RGB in 0…1.
        limits: rasterizer constants.
        device: Warp device, such as "cpu" or "cuda:0".
        image_weight: weight of the image loss in ``compare``.

    Attributes:
        device, limits, background: same as the arguments.
    """

    def __init__(
        self,
        background: tuple[float, float, float],
        limits: Limits = DEFAULT,
        device: str = "cuda:0",
        image_weight: float = 1.0,
    ) -> None:
        self.device, self.limits, self.background = device, limits, background
        self._background = np.array([*background, 0.0], np.float32)
        self._loss = PictureLoss(device, image_weight, 0.0)
        self._rasterizer = Rasterizer(device, 0, limits)
        self._first = wp.zeros(1, dtype=wp.int32, device=device)
        self._behind = wp.zeros(1, dtype=wp.vec4, device=device)
        self._log = wp.zeros((1, COLUMNS), dtype=wp.float32, device=device)

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
        if depth_channel >= 0:
            shown = shown.copy()
            shown[:, depth_channel] = state.means @ camera.pose[2, :3] + camera.pose[2, 3]
        if background is None:
            background = np.zeros(shown.shape[1], np.float32)
            background[:CHANNELS] = self._background
        cameras = self._projected(state, camera, shown)
        drawn = []
        for group in range(0, shown.shape[1], CHANNELS):
            channels = slice(group, group + CHANNELS)
            self._rasterize(cameras, shown[:, channels], background[channels])
            drawn.append(self._rasterizer.planes.numpy()[:, : camera.height, : camera.width].copy())
        return Picture(np.concatenate([planes[:CHANNELS] for planes in drawn]), drawn[0][CHANNELS])

    def compare(self, state: Gaussians, view: TrainingView, features: Array | None = None) -> Comparison:
        """See ``Renderer.compare``."""
        shown = features_seen(state, view.camera) if features is None else features
        cameras = self._projected(state, view.camera, shown)
        self._rasterize(cameras, shown, self._background)
        self._loss.load([view])
        self._loss.measure(self._first, self._first, self._rasterizer, self._behind, self._log)
        log = self._log.numpy()[0].astype(float)
        red, green, blue = log[SHIFT : SHIFT + 3].tolist()
        psnr = psnr_of(float(log[SQUARES]), view.camera.width * view.camera.height)
        return Comparison(psnr, float(log[IMAGE_LOSS]), (red, green, blue))

    def gather(self, state: Gaussians, camera: CameraArrays, planes: Array) -> Array:
        """See ``Renderer.gather``. The sums are computed as feature gradients of a weighted sum of pixels."""
        features = np.zeros((len(state), CHANNELS), np.float32)
        cameras = self._projected(state, camera, features)
        on_device = self._rasterize(cameras, features, np.zeros(CHANNELS, np.float32))
        rasterizer = self._rasterizer
        given = np.zeros(rasterizer.g_planes.shape, np.float32)
        given[: len(planes), : camera.height, : camera.width] = planes
        rasterizer.g_planes.assign(given)
        rasterizer.carry_back(cameras, self._first, on_device)
        records = rasterizer.records.numpy().reshape(len(state), 4 * RECORD)
        sums: Array = records[:, FEATURES : FEATURES + len(planes)].copy()
        return sums

    def residuals(
        self, state: Gaussians, view: TrainingView, learnt: NDArray[np.uint8], most: float
    ) -> tuple[Array, Array]:
        """See ``Renderer.residuals``."""
        shown = self.render(state, view.camera).features[:LABEL]
        gain, offset = view.exposure[:3, :1, None], view.exposure[:3, 1:, None]
        more = np.clip((view.target[:LABEL] - offset) / gain - shown, -most, most)
        sums = self.gather(state, view.camera, np.concatenate([more, np.ones_like(more[:1])]))
        sums *= learnt[:, None]
        return sums[:, :LABEL], sums[:, LABEL]

    def reached(self, state: Gaussians, rows: NDArray[np.int64], camera: CameraArrays) -> NDArray[np.bool_]:
        """See ``Renderer.reached``."""
        chosen = state.rows(rows)
        cameras = self._projected(chosen, camera, np.zeros((len(rows), CHANNELS), np.float32))
        height, width = (-(-size // PADDING) * PADDING // BLOCK for size in (camera.height, camera.width))
        marks = wp.zeros((height, width), dtype=wp.int32, device=self.device)
        self._rasterizer.mark(cameras, BLOCK, marks)
        blocks: NDArray[np.bool_] = marks.numpy() != 0
        return blocks

    def _projected(self, state: Gaussians, camera: CameraArrays, features: Array) -> wp.array:
        """Projects a state and builds sufficiently large tile lists. Returns the camera as a [1] device array."""
        device, count = self.device, len(state)
        if count != self._rasterizer.count or not self._rasterizer.holds(camera.width, camera.height):
            self._rasterizer = Rasterizer(device, count, self.limits)
            self._rasterizer.resize(camera.width, camera.height)
        cameras = wp.array([camera_of(camera)], dtype=Camera, device=device)
        # Projection gets placeholder features, because there may be more than four. Gaussians that it would cull for
        # invalid features get zero opacity instead.
        sound = (np.abs(features) <= FEATURE_CEILING).all(axis=1)
        means = wp.array(state.means, dtype=wp.vec3, device=device)
        factors = wp.array(state.factors, dtype=wp.mat33, device=device)
        opacities = wp.array(np.where(sound, state.opacities, np.float32(0)), dtype=wp.float32, device=device)
        unseen = wp.zeros(count, dtype=wp.vec4, device=device)
        given = (cameras, self._first, means, factors, opacities, unseen, self._first, self._log)
        self._rasterizer.project(*given)
        while self._rasterizer.grow(self._log.numpy()[0, PAIRS]):
            self._rasterizer.project(*given)
        return cameras

    def _rasterize(self, cameras: wp.array, features: Array, background: Array) -> wp.array:
        """Rasterizes features [N, 4] of the projected Gaussians, and returns the uploaded features."""
        on_device = wp.array(np.ascontiguousarray(features, np.float32), dtype=wp.vec4, device=self.device)
        self._behind.assign(background[None])
        self._rasterizer.draw(cameras, self._first, on_device, self._behind)
        return on_device
