"""Rendered views of a state from any camera: colour, depth, alpha, and the part that covers each pixel."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Camera, WorldFrame
from scas4d_core.engines.choose import Device, renderer_of
from scas4d_core.engines.limits import DEFAULT, Limits
from scas4d_core.engines.renderer import CHANNELS, Renderer
from scas4d_core.engines.views import LABEL, CameraArrays
from scas4d_core.gaussians import Gaussians
from scas4d_core.query.tracks import ALPHA_OF_A_SURFACE

Array = NDArray[np.float32]
T = TypeVar("T")

log = logging.getLogger("scas4d.renderer")

MAX_LABEL = 254
"""Largest part label. A part is stored in 8 bits as 1 + its label, and 0 means no part."""


@dataclass(frozen=True, eq=False)
class View:
    """A rendered view.

    Attributes:
        colour: [H, W, 3] float32 RGB over the background, nominally in [0, 1].
        alpha: [H, W] float32 opacity.
        depth: [H, W] float32 alpha-weighted mean z along the camera's axis, in user units; NaN if less than half of
            the pixel is covered.
        parts: [H, W] uint8: 1 + the label that covers most of the pixel, or 0 for no part; None without labels.

    >>> black = np.zeros((2, 2), np.float32)
    >>> view = View(np.zeros((2, 2, 3), np.float32), alpha=black, depth=np.full_like(black, np.nan))
    >>> view.colour.shape, view.parts is None  # rendered without labels
    ((2, 2, 3), True)
    """

    colour: Array
    alpha: Array
    depth: Array
    parts: NDArray[np.uint8] | None = None


class ViewRenderer:
    """Renderer for views of states, which reuses its buffers between views.

    Args:
        world: transform from the user's world to the internal world of the states.
        limits: rasterizer constants.
        device: device that renders. If a GPU fails, for example because its memory is full, the CPU renders instead.

    Attributes:
        world: same as the argument.
        device: device that currently renders.

    >>> state = Gaussians.of_points([[0, 0, 2]], radius=0.1, colours=[1, 0, 0])
    >>> camera = Camera("front", [[100, 0, 8], [0, 100, 8], [0, 0, 1]], np.eye(4), 16, 16)
    >>> renderer = ViewRenderer(WorldFrame(np.zeros(3)))
    >>> renderer.render(state, camera, background=(0, 0, 1)).colour[8, 8].round(1)
    array([0.9, 0. , 0.1], dtype=float32)
    >>> green = np.array([[0, 1, 0]], np.float32)
    >>> renderer.render(state, camera, colours=green).colour[8, 8].round(1)
    array([0. , 0.9, 0. ], dtype=float32)
    """

    def __init__(self, world: WorldFrame, limits: Limits = DEFAULT, device: Device = "cpu") -> None:
        self.world = world
        self._limits = limits
        self.device = device
        self._made: Renderer | None = None

    @property
    def _renderer(self) -> Renderer:
        """Renderer on the current device, created on first use."""
        if self._made is None:
            self._made = renderer_of(self.device, (0.0, 0.0, 0.0), self._limits)
        return self._made

    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        *,
        colours: Array | None = None,
        labels: NDArray[Any] | None = None,
    ) -> View:
        """Renders a view of a state.

        Args:
            gaussians: state of N Gaussians in the internal world.
            camera: camera in the user's world.
            background: background colour, RGB in [0, 1].
            colours: [N, 3] float32 RGB to use instead of the state's colours, or None for the colours seen by this
                camera.
            labels: [N] part label of each Gaussian, −1 for none; required for ``View.parts``.

        Raises:
            ValueError: if the labels have the wrong shape or are out of range.
        """
        return self._or_on_the_cpu(lambda: self._render(gaussians, camera, background, colours, labels))

    def render_levels(
        self, gaussians: Gaussians, camera: Camera, background: tuple[float, float, float], *, opacity: bool
    ) -> NDArray[np.uint8]:
        """Renders ``View.colour`` [H, W, 3], or ``View.alpha`` [H, W], rounded to 8 bits.

        A GPU then transfers a quarter of the bytes or less.

        Args:
            gaussians, camera, background: see ``render``.
            opacity: whether to return the opacity instead of the colours.
        """
        arrays, behind = CameraArrays.of(self.world.camera_to_inside(camera)), np.array([*background, 0.0], np.float32)
        return self._or_on_the_cpu(lambda: self._renderer.render_levels(gaussians, arrays, behind, opacity=opacity))

    def _or_on_the_cpu(self, render: Callable[[], T]) -> T:
        """Returns the result of a rendering function, which is repeated on the CPU if the GPU fails."""
        try:
            return render()
        except RuntimeError as error:  # raised by NVIDIA Warp if memory is full or the GPU fails
            if self.device == "cpu":
                raise
            log.warning("the GPU could not render a view; views are now rendered on the CPU: %s", error)
            self.device, self._made = "cpu", None
            return render()

    def _render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        background: tuple[float, float, float],
        colours: Array | None,
        labels: NDArray[Any] | None,
    ) -> View:
        inside = self.world.camera_to_inside(camera)
        arrays = CameraArrays.of(inside)
        picture = self._renderer.render(
            gaussians,
            arrays,
            None if colours is None else gaussians.features(colours),
            depth_channel=LABEL,  # the label channel is not needed in a view
            background=np.array([*background, 0.0], np.float32),
        )
        colour = np.moveaxis(picture.features[:3], 0, -1).copy()
        alpha = 1 - picture.transmittance
        with np.errstate(invalid="ignore", divide="ignore"):
            depth = picture.features[LABEL] / alpha / np.float32(self.world.metres_per_unit)
        depth[alpha < ALPHA_OF_A_SURFACE] = np.nan
        parts = None if labels is None else self._parts_picture(gaussians, np.asarray(labels), arrays)
        return View(colour, alpha, depth, parts)

    def _parts_picture(self, gaussians: Gaussians, labels: NDArray[Any], camera: CameraArrays) -> NDArray[np.uint8]:
        """Returns the part that covers most of each pixel (``View.parts``). Each pass renders ``CHANNELS`` labels."""
        if labels.shape != (len(gaussians),) or not ((labels >= -1) & (labels <= MAX_LABEL)).all():
            raise ValueError(
                f"labels must have shape [{len(gaussians)}], one per Gaussian, with values in -1...{MAX_LABEL}; got "
                f"shape {labels.shape}"
            )
        painted = np.zeros((camera.height, camera.width), np.uint8)
        most = np.full(painted.shape, -1.0, np.float32)
        black = np.zeros(CHANNELS, np.float32)
        for first in range(-1, int(labels.max(initial=-1)) + 1, CHANNELS):
            weights = (labels[:, None] == np.arange(first, first + CHANNELS)).astype(np.float32)
            picture = self._renderer.render(gaussians, camera, weights, background=black)
            best = picture.features.max(axis=0)
            wins = best > most
            painted[wins] = (first + 1 + picture.features.argmax(axis=0))[wins]
            most[wins] = best[wins]
        painted[picture.transmittance > 1 - ALPHA_OF_A_SURFACE] = 0
        return painted
