"""Interface for all rendering outside an iteration: checks, births, frame 0 and client views."""

from __future__ import annotations

from math import log10
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.views import CameraArrays, TrainingView
from scas4d_core.gaussians import Gaussians
from scas4d_core.guards import SMALLEST_SQUARE

Array = NDArray[np.float32]


CHANNELS = 4
"""Number of features rendered per pass: red, green, blue, label."""
BLOCK = 4
"""Side of a block in pixels, see ``Renderer.reached``."""


class Picture(NamedTuple):
    """A rendered picture. It may share a buffer of the renderer, which the next call overwrites.

    Attributes:
        features: [C, H, W] float32, before the camera's exposure.
        transmittance: [H, W] float32, remaining transmittance.
    """

    features: Array
    transmittance: Array


def psnr_of(squares: float, pixels: int) -> float:
    """Returns the PSNR in dB of a picture from its summed squared error over pixels and RGB; finite for equal pictures.

    >>> round(psnr_of(0.03 * 64, pixels=64), 6)  # an error of 0.1 in every value
    20.0
    """
    return 10 * log10(3 * pixels / max(squares, SMALLEST_SQUARE))


class Comparison(NamedTuple):
    """Comparison of a rendered state with the picture of a view.

    Attributes:
        psnr: dB. image_loss: 0.8 L1 + 0.2 (1 − SSIM), weighted.
        colour_shift: [3] mean of the picture minus mean of the rendering, RGB in 0…1, with exposure applied.
    """

    psnr: float
    image_loss: float
    colour_shift: tuple[float, float, float]


class Gradients(NamedTuple):
    """Gradients of a loss with respect to the renderer's inputs; the next call overwrites these buffers.

    Attributes:
        means: [N, 3]. factors: [N, 3, 3]. opacities: [N]. features: [N, C]. screen: [N, 2] for the projected means.
            Gaussians that are not rendered have gradient 0.
    """

    means: Array
    factors: Array
    opacities: Array
    features: Array
    screen: Array


class Renderer(Protocol):
    """Renders states of one scene, with its background and limits.

    Colours are those that the camera sees, gloss included. If ``features`` [N, C] are given, they are rendered instead;
    C is a multiple of ``CHANNELS``.
    """

    def render(
        self,
        state: Gaussians,
        camera: CameraArrays,
        features: Array | None = None,
        *,
        depth_channel: int = -1,
        background: Array | None = None,
    ) -> Picture:
        """Renders RGB and label of a state as a camera sees it, without the camera's exposure.

        Args:
            features: [N, C] features to render instead of RGB and label.
            depth_channel: channel of ``features`` to overwrite with the depth of the centres (metres along z).
            background: [C] float32 behind all Gaussians; None: the scene's background, and 0 in further channels.
        """

    def compare(self, state: Gaussians, view: TrainingView, features: Array | None = None) -> Comparison:
        """Renders a state and compares it with the picture of a view; see ``render``."""

    def gather(self, state: Gaussians, camera: CameraArrays, planes: Array) -> Array:
        """Returns the [N, P] sums over pixels of planes [P, H, W], weighted by each Gaussian's blending weights; P ≤ 4.

        A plane of ones gives the number of pixels that each Gaussian covers.
        """

    def residuals(
        self, state: Gaussians, view: TrainingView, learnt: NDArray[np.uint8], most: float
    ) -> tuple[Array, Array]:
        """Returns the residual (picture minus rendering) summed over pixels with each Gaussian's blending weights.

        Args:
            learnt: [N] 1 for the Gaussians whose sums are needed.
            most: limit to which residuals are clipped, RGB in 0…1.

        Returns:
            [N, 3] weighted RGB sums without the camera's exposure, and [N] sums of the weights (pixels).
        """

    def reached(self, state: Gaussians, rows: NDArray[np.int64], camera: CameraArrays) -> NDArray[np.bool_]:
        """Returns a padded [h, w] bool grid of the ``BLOCK``-pixel blocks that the rows' supports intersect."""
