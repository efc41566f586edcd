"""The interface between the loop of a fit and the device that computes it, and the values that cross it.

The loop (``fit.gaussian_fit``) decides; an engine computes. ``choose.fit_engine_of`` makes an engine::

    engine.load_views(views, fixed)      # pictures, and the Gaussians that stay fixed in each
    engine.load_table(table)             # parameters and moments; again whenever the host has changed them
    engine.iterate(view, scalars)        # activate, render, compare, backward, Adam: once an iteration
    engine.table(), engine.state()       # what was fitted
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
"""Columns of the table of parameters: metres, quaternion, log metres, logit, RGB in 0…1, logit."""
COLUMNS = 15


@dataclass(eq=False)
class RenderingStatistics:
    """Sums over the renderings since the last change of rows, for each Gaussian; density control reads them.

    Attributes:
        screen_gradients: [N] sum of the lengths of the screen gradients, per half picture. rendered: [N] times it was
            in a picture.
        factors: [N, 3, 3] as the last iteration rendered them, before its step.
    """

    screen_gradients: NDArray[np.float64]
    rendered: NDArray[np.int64]
    factors: Array

    @classmethod
    def empty(cls, count: int) -> RenderingStatistics:
        """Before any rendering."""
        return cls(np.zeros(count), np.zeros(count, np.int64), np.zeros((count, 3, 3), np.float32))


class FitGloss(Protocol):
    """Gloss of the fitted Gaussians and their environment, as one kind of engine learns them.

    Attributes:
        gloss: [N, 3] normals times strengths. environment: see ``Gaussians``.
    """

    gloss: Array
    environment: Array

    def select_rows(self, rows: NDArray[np.int64], parents: NDArray[np.int64]) -> Self:
        """The same for some rows, with their moments, and for further ones like their parents, without."""


@dataclass(eq=False)
class FitTable:
    """The parameters of a fit with their Adam moments.

    Attributes:
        parameters, first, second: [N, 15] float32, columns as above. steps: of Adam so far.
        beta1, beta2: Adam's decays. statistics: None where nobody reads them.
        gloss: by which colours depend on direction, learnt as well; None: they do not.
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
    """Rates of one iteration, and the figures that are asked of it.

    Attributes:
        rates: [15] float32, Adam's of each column; a column whose rate is 0 stays.
        gloss: factor on the rates of the gloss. colour_shift: whether it is measured.
    """

    rates: Array
    gloss: float = 1.0
    colour_shift: bool = False


class FitLoss(NamedTuple):
    """The picture of one iteration, before its step.

    Attributes:
        view: index of the view. loss: weighted sum of image and mask loss. psnr: dB.
        exposure_gradient: [C, 2] of the loss with respect to the camera's gain and offset; valid until the next one.
        colour_shift: [3] mean of the picture minus mean of the rendering; None where it was not asked for.
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
        """Draws states in the buffers of the iterations."""

    def load_views(self, views: Sequence[TrainingView], fixed: Sequence[Gaussians] = ()) -> None:
        """Take the pictures of the fit. An iteration reads the exposure that its view has then.

        Args:
            fixed: for each view, Gaussians that are drawn with the fitted ones and stay as they are; empty: none.
        """

    def load_table(self, table: FitTable) -> None:
        """Take parameters, moments, statistics and gloss.

        Raises:
            EngineError: the engine cannot learn this gloss.
        """

    def iterate(self, view: int, scalars: FitScalars) -> FitLoss:
        """One iteration: render a view, compare it with its picture, carry the gradient back, step Adam."""

    def table(self) -> FitTable:
        """The table as it is now."""

    def state(self) -> Gaussians:
        """The fitted Gaussians, without the fixed ones; their labels are between 0 and 1."""
