"""Interface between the optimization loop of a fit and the engine that runs it, with the data they exchange.

The loop (``fit.gaussian_fit``) makes the decisions, and the engine does the computation. ``choose.fit_engine_of``
creates an engine::

    engine.load_views(views, fixed)      # training images, and the fixed Gaussians of each view
    engine.load_table(table)             # parameters and moments; call again after changing them on the host
    engine.iterate(view, scalars)        # once per iteration: activate, render, compare, backward, Adam
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
"""Columns of the parameter table: mean in metres, quaternion, log scale, opacity logit, RGB in [0, 1], label logit."""
COLUMNS = 15


@dataclass(eq=False)
class RenderingStatistics:
    """Per-Gaussian statistics for density control, accumulated since rows were last added or removed.

    Attributes:
        screen_gradients: [N] summed gradient norms with respect to the projected mean, where the mean is in units of
            half the image size.
        rendered: [N] number of renderings in which the Gaussian was visible.
        factors: [N, 3, 3] covariance factors rendered in the last iteration, before its Adam step.
    """

    screen_gradients: NDArray[np.float64]
    rendered: NDArray[np.int64]
    factors: Array

    @classmethod
    def empty(cls, count: int) -> RenderingStatistics:
        """Returns statistics initialized to zero for ``count`` Gaussians."""
        return cls(np.zeros(count), np.zeros(count, np.int64), np.zeros((count, 3, 3), np.float32))


class FitGloss(Protocol):
    """Engine-specific representation of the gloss and environment that a fit learns.

    Attributes:
        gloss: [N, 3] normal of each Gaussian, scaled by its gloss strength.
        environment: [ROWS, 3] environment; see ``Gaussians``.
    """

    gloss: Array
    environment: Array

    def select_rows(self, rows: NDArray[np.int64], parents: NDArray[np.int64]) -> Self:
        """Returns the gloss and moments of ``rows``, followed by copies of ``parents`` with zero moments."""


@dataclass(eq=False)
class FitTable:
    """The parameters of a fit and their Adam moments.

    Attributes:
        parameters: [N, 15] float32 parameters; see the column constants above.
        first, second: [N, 15] float32 first and second Adam moments.
        beta1, beta2: Adam's decay rates.
        steps: number of Adam steps so far.
        statistics: statistics for density control, or None if they are not needed.
        gloss: learned view-dependent part of the colours, or None if colours do not depend on the view.
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
        rates: [15] float32 Adam learning rate of each column. A column with rate 0 is not updated.
        gloss: factor that scales the learning rates of the gloss.
        colour_shift: whether to compute ``FitLoss.colour_shift``.
    """

    rates: Array
    gloss: float = 1.0
    colour_shift: bool = False


class FitLoss(NamedTuple):
    """Losses of one iteration, computed before its Adam step.

    Attributes:
        view: index of the rendered view.
        loss: weighted sum of the image and mask losses.
        psnr: PSNR of the rendering, in dB.
        exposure_gradient: [C, 2] gradient of the loss with respect to the camera's gain and offset. The array may be a
            buffer that the next iteration overwrites.
        colour_shift: [3] mean of the training image minus mean of the rendering, or None if it was not requested.
    """

    view: int
    loss: float
    psnr: float
    exposure_gradient: Array
    colour_shift: tuple[float, float, float] | None


class FitEngine(Protocol):
    """Interface of an engine that runs the iterations of one fit on one device."""

    @property
    def renderer(self) -> Renderer:
        """Renderer for states. An iteration may overwrite its results."""

    def load_views(self, views: Sequence[TrainingView], fixed: Sequence[Gaussians] = ()) -> None:
        """Loads the training images of the fit. The caller may change their exposures in place between iterations.

        Args:
            views: training views. ``iterate`` refers to them by index.
            fixed: for each view, the Gaussians that are rendered together with the fitted ones but not updated. The
                sequence is empty if there are none.
        """

    def load_table(self, table: FitTable) -> None:
        """Loads parameters, moments, statistics and gloss.

        Raises:
            EngineError: if the engine does not support this type of gloss.
        """

    def iterate(self, view: int, scalars: FitScalars) -> FitLoss:
        """Runs one iteration: renders a view, computes and backpropagates its loss, and takes an Adam step.

        Args:
            view: index of the training view to render.
            scalars: learning rates and options of the iteration.
        """

    def table(self) -> FitTable:
        """Returns the current parameter table.

        Until the next iteration, every call returns the same arrays. They may be edited and then loaded again.
        """

    def state(self) -> Gaussians:
        """Returns the fitted Gaussians, without the fixed ones. Their labels are values between 0 and 1."""
