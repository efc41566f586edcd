"""Interface between the loop of a fit and the device that computes it, and the values that cross it.

The loop (``fit.gaussian_fit``) decides, an engine computes. ``choose.fit_engine_of`` creates an engine::

    engine.load_views(views, fixed)      # pictures, and the Gaussians that stay fixed in each
    engine.load_table(table)             # parameters and moments; repeat whenever the host has changed them
    engine.iterate(view, scalars)        # activate, render, compare, backward, Adam: once per iteration
    engine.table(), engine.state()       # the fitted parameters and Gaussians
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.renderer import Renderer
from scas4d_core.engines.views import TrainingView
from scas4d_core.gaussians import Gaussians

Array = NDArray[np.float32]

MEAN, QUATERNION, SCALE, OPACITY, COLOUR, LABEL = (
    slice(0, 3), slice(3, 7), slice(7, 10), slice(10, 11), slice(11, 14), slice(14, 15)
)  # fmt: skip
"""Columns of the parameter table: metres, quaternion, log metres, logit, RGB in 0…1, logit."""
COLUMNS = 15


@dataclass(eq=False)
class RenderingStatistics:
    """Per-Gaussian sums over the renderings since rows last changed, used for density control.

    Attributes:
        screen_gradients: [N] sum of the norms of the screen-space gradients, in units of half the picture's size.
        rendered: [N] number of renderings that contained the Gaussian.
        factors: [N, 3, 3] as rendered by the last iteration, before its step.
    """

    screen_gradients: NDArray[np.float64]
    rendered: NDArray[np.int64]
    factors: Array

    @classmethod
    def empty(cls, count: int) -> RenderingStatistics:
        """Returns zero statistics for a number of Gaussians."""
        return cls(np.zeros(count), np.zeros(count, np.int64), np.zeros((count, 3, 3), np.float32))


class FitGloss(Protocol):
    """Gloss and environment of the fitted Gaussians, as learned by one type of engine.

    Attributes:
        gloss: [N, 3] normals times strengths. environment: see ``Gaussians``.
    """

    gloss: Array
    environment: Array

    def select_rows(self, rows: NDArray[np.int64], parents: NDArray[np.int64]) -> Self:
        """Returns the gloss of some rows with their moments, then copies of the parents' rows with zero moments."""


@dataclass(eq=False)
class FitTable:
    """The parameters of a fit and their Adam moments.

    Attributes:
        parameters, first, second: [N, 15] float32, columns as above. steps: number of Adam steps so far.
        beta1, beta2: Adam's decay rates. statistics: None if they are not needed.
        gloss: learned direction-dependent part of the colours; None: colours do not depend on direction.
    """

    parameters: Array
    first: Array
    second: Array
    beta1: np.float32
    beta2: np.float32
    steps: int = 0
    statistics: RenderingStatistics | None = None
    gloss: FitGloss | None = None


class FitScalars(NamedTuple):
    """Learning rates and options of one iteration.

    Attributes:
        rates: [15] float32, Adam learning rate of each column; a column with rate 0 is not updated.
        gloss: factor on the learning rates of the gloss. colour_shift: whether to measure the colour shift.
    """

    rates: Array
    gloss: float = 1.0
    colour_shift: bool = False


class FitLoss(NamedTuple):
    """Losses of the rendering of one iteration, before its step.

    Attributes:
        view: index of the view. loss: weighted sum of image and mask loss. psnr: dB.
        exposure_gradient: [C, 2] gradient of the loss with respect to the camera's gain and offset; valid until the
            next iteration.
        colour_shift: [3] mean of the picture minus mean of the rendering; None if it was not requested.
    """

    view: int
    loss: float
    psnr: float
    exposure_gradient: Array
    colour_shift: tuple[float, float, float] | None


class FitEngine(Protocol):
    """Computes one fit on one device."""

    @property
    def renderer(self) -> Renderer:
        """Returns the renderer of states, which shares its buffers with the iterations."""

    def load_views(self, views: Sequence[TrainingView], fixed: Sequence[Gaussians] = ()) -> None:
        """Loads the pictures of the fit. Each iteration reads the current exposure of its view.

        Args:
            fixed: for each view, Gaussians that are rendered with the fitted ones but not updated; empty: none.
        """

    def load_table(self, table: FitTable) -> None:
        """Loads parameters, moments, statistics and gloss.

        Raises:
            EngineError: if the engine cannot learn this kind of gloss.
        """

    def iterate(self, view: int, scalars: FitScalars) -> FitLoss:
        """Runs one iteration: renders a view, compares it with its picture, backpropagates the loss and steps Adam."""

    def table(self) -> FitTable:
        """Returns the current parameter table."""

    def state(self) -> Gaussians:
        """Returns the fitted Gaussians without the fixed ones; their labels are between 0 and 1."""
