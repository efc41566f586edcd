"""One training view rendered, compared and carried back: what frame 0 and every update do each iteration."""

from __future__ import annotations

from collections.abc import Callable
from math import log10

import numpy as np
from numpy.typing import NDArray

from scas4d_core.guards import SMALLEST_SQUARE
from scas4d_core.kernels import image_loss
from scas4d_core.rasterize.cpu import CpuRasterizer, Gradients
from scas4d_core.rasterize.limits import DEFAULT, Limits
from scas4d_core.update.views import CHANNELS, LABEL, TrainingView, ViewFactory, means

Array = NDArray[np.float32]


def _no_lap(stage: str) -> None:
    """Nobody takes the time."""


class PictureLoss:
    """The image and mask loss of a set of Gaussians in one view, with gradients.

    Args:
        background: RGB behind everything.
        image_weight, mask_weight: weights of the two terms.
        mask_moves: whether the mask loss pulls at positions and shapes, or at the labels alone: masks have hard edges,
            and a silhouette fitted to them is not the one that fits the pictures.
    """

    def __init__(
        self,
        factory: ViewFactory,
        background: tuple[float, float, float],
        image_weight: float,
        mask_weight: float,
        mask_moves: bool = True,
        limits: Limits = DEFAULT,
    ) -> None:
        self.rasterizer = CpuRasterizer(limits)
        self._factory = factory
        self._detached = -1 if mask_moves else LABEL
        self._background = np.array([*background, 0.0], np.float32)
        self._weights = np.array([image_weight / 3] * 3 + [mask_weight], np.float32)
        self.exposure_gradient = np.zeros((CHANNELS, 2), np.float32)
        self.image_part = 0.0
        self.mask_part = 0.0
        self.psnr = 0.0

    def evaluate(
        self,
        means: Array,
        factors: Array,
        opacities: Array,
        features: Array,
        view: TrainingView,
        lap: Callable[[str], None] = _no_lap,
    ) -> Gradients:
        """Render the view, set ``image_part``, ``mask_part`` and ``psnr`` (dB), and return the gradients.

        The gradients are buffers, valid until the next call.

        Args:
            means, factors, opacities, features: [N, 3], [N, 3, 3], [N], [N, 4] (RGB, label), float32.
            lap: told when each stage is done.
        """
        self.rasterizer.forward(means, factors, opacities, features, view.camera, self._background)
        lap("render")
        g_image, g_alpha = self.rasterizer.gradient_buffers()
        self._compare(view, g_image)
        lap("picture loss")
        gradients = self.rasterizer.backward(g_image, g_alpha, self._detached)
        lap("render backward")
        return gradients

    def measure(self, means: Array, factors: Array, opacities: Array, features: Array, view: TrainingView) -> None:
        """Render the view and set ``image_part``, ``mask_part`` and ``psnr``, without gradients; see ``evaluate``."""
        self.rasterizer.forward(means, factors, opacities, features, view.camera, self._background)
        g_image, _ = self.rasterizer.gradient_buffers()
        self._compare(view, g_image)

    def _compare(self, view: TrainingView, g_image: Array) -> None:
        """Fill the losses of what was rendered, and its gradient."""
        channels, height, width = view.target.shape
        rows = np.empty((channels, height, 2), np.float32)
        g_exposure = np.empty((channels, height, 2), np.float32)
        image_loss.image_loss(
            self.rasterizer.planes,
            view.exposure,
            view.target,
            *view.moments,
            self._weights[:channels],
            self._factory.scratch(channels, height, width),
            g_image,
            rows,
            g_exposure,
        )
        g_image[channels:] = 0
        sums = rows.sum(axis=1, dtype=np.float64)
        self.image_part, self.mask_part = float(sums[:3, 0].sum()), float(sums[3:, 0].sum())
        self.psnr = 10 * log10(3 * height * width / max(float(sums[:3, 1].sum()), SMALLEST_SQUARE))
        self.exposure_gradient[:channels] = g_exposure.sum(axis=1)

    def colour_shift(self, view: TrainingView) -> tuple[float, float, float]:
        """Mean of the view's picture minus mean of what was rendered for it last, exposure included, RGB in 0…1."""
        height, width = view.camera.height, view.camera.width
        rendered = means(self.rasterizer.planes[:3, :height, :width])
        shown = view.exposure[:3, 0] * rendered + view.exposure[:3, 1]
        red, green, blue = (view.mean - shown).tolist()
        return red, green, blue

    def coverage(
        self,
        means: Array,
        factors: Array,
        opacities: Array,
        features: Array,
        view: TrainingView,
        pixels: Array | float = 1.0,
    ) -> Array:
        """[N] pixels' worth of blending weight of each Gaussian in a view; the gradient of a channel's sum.

        Args:
            pixels: [H, W] what each pixel counts.
        """
        self.rasterizer.forward(means, factors, opacities, features, view.camera, self._background)
        g_image, g_alpha = self.rasterizer.gradient_buffers()
        g_image[:] = 0
        g_image[LABEL, : view.camera.height, : view.camera.width] = pixels
        weights = self.rasterizer.backward(g_image, g_alpha, LABEL).features[:, LABEL].copy()
        g_image[:] = 0
        return weights
