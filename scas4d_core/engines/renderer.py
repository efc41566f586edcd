"""The interface of everything that draws a state outside an iteration: checks, births, frame 0, views of clients."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.views import CameraArrays, TrainingView
from scas4d_core.gaussians import Gaussians

Array = NDArray[np.float32]


CHANNELS = 4
"""Red, green, blue, label; features are drawn so many at a time."""
BLOCK = 4
"""Pixels of the side of a block, see ``Renderer.reached``."""


class Picture(NamedTuple):
    """A rendered picture; it may lie in a buffer of the renderer, valid until its next call.

    Attributes:
        features: [C, H, W] float32, before the camera's exposure. transmittance: [H, W] float32, transmittance left.
    """

    features: Array
    transmittance: Array


class Comparison(NamedTuple):
    """A state compared with the picture of a view.

    Attributes:
        psnr: dB. image_loss: 0.8 L1 + 0.2 (1 − SSIM), weighted.
        colour_shift: [3] mean of the picture minus mean of the rendering, RGB in 0…1, exposure included.
    """

    psnr: float
    image_loss: float
    colour_shift: tuple[float, float, float]


class Gradients(NamedTuple):
    """Gradients of a loss with respect to what was drawn; buffers of the renderer, valid until its next call.

    Attributes:
        means: [N, 3]. factors: [N, 3, 3]. opacities: [N]. features: [N, C]. screen: [N, 2] of the projected means.
            Gaussians that are not drawn have 0.
    """

    means: Array
    factors: Array
    opacities: Array
    features: Array
    screen: Array


class Renderer(Protocol):
    """Draws states of one scene, with its background and limits.

    Colours are those that the camera sees: gloss is part of a state. ``features`` [N, C], where given, are drawn
    instead; C is a multiple of ``CHANNELS``.
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
        """RGB and label of a state as a camera sees it, without the camera's exposure.

        Args:
            features: [N, C] drawn instead of RGB and label.
            depth_channel: channel of ``features`` that is filled with the depth of the centres (metres along z).
            background: [C] float32 behind every Gaussian; None: the scene's, and 0 in further channels.
        """

    def compare(self, state: Gaussians, view: TrainingView, features: Array | None = None) -> Comparison:
        """The state beside the picture of a view; see ``render``."""

    def gather(self, state: Gaussians, camera: CameraArrays, planes: Array) -> Array:
        """[N, P] sums of planes [P, H, W], P up to 4, over the pixels, by each Gaussian's blending weight.

        A plane of ones gives the pixels' worth that each Gaussian covers.
        """

    def residuals(
        self, state: Gaussians, view: TrainingView, learnt: NDArray[np.uint8], most: float
    ) -> tuple[Array, Array]:
        """Sums over the pixels of picture minus rendering, and of 1, by each Gaussian's blending weight.

        Args:
            learnt: [N] 1 for the Gaussians whose sums are asked for. most: RGB in 0…1 to which a pixel is clipped.

        Returns:
            [N, 3] RGB in pixels' worth, without the camera's exposure, and [N] pixels' worth.
        """

    def reached(self, state: Gaussians, rows: NDArray[np.int64], camera: CameraArrays) -> NDArray[np.bool_]:
        """[h, w] bool, blocks of ``BLOCK`` pixels a side that the supports of some Gaussians meet; padded."""
