"""Training loop that fits Gaussians to images outside of updates.

The loop fits frame 0 and new objects, and refines new objects. These cases differ only in the
arguments of ``GaussianFit.run``: the order of views, the learning rates, the schedule, and the
callback after each iteration.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.fit import FitEngine, FitGloss, FitLoss, FitScalars, FitTable, RenderingStatistics
from scas4d_core.engines.views import TrainingView
from scas4d_core.gaussians import Gaussians

if TYPE_CHECKING:
    from scas4d_core.fit.exposures import Exposures

Array = NDArray[np.float32]

BETA1, BETA2 = np.float32(0.9), np.float32(0.999)
"""Default Adam decay rates, as in 3DGS."""


@dataclass(frozen=True)
class FitStep:
    """Step of one iteration, from the positions ``begun`` to ``ended`` in the full schedule.

    >>> step = FitStep(99.0, 101.5)
    >>> step.reaches(100), step.reaches(102), step.passes(100), step.passes(70)
    (True, False, True, False)
    """

    begun: float
    ended: float

    def reaches(self, moment: float) -> bool:
        """Returns whether this step reaches a given point of the schedule."""
        return self.begun < moment <= self.ended

    def passes(self, every: float) -> bool:
        """Returns whether this step passes or reaches a multiple of ``every``."""
        return self.ended // every > self.begun // every


def each_once(done: int) -> FitStep:
    """Returns the step of iteration ``done``, counted from 0, for a schedule that skips no iteration."""
    return FitStep(done, done + 1)


def never(now: FitStep, last: FitLoss) -> bool:
    """Always returns false, so that the fit does not end early."""
    return False


class GaussianFit:
    """Fit of Gaussians, the rows of a parameter table, to views.

    Args:
        engine: fit engine, which must not be shared with another fit.
        views: views to fit.
        parameters: [N, 15] parameter table with the columns of ``engines.fit``. It is changed in
            place.
        fixed: for each view, the Gaussians that are rendered together with the fitted Gaussians but
            not updated. The sequence is empty if there are none.
        gloss: gloss of view-dependent colours, which is also learnt, or None for constant colours.
        exposures: exposures of the views, which are also learnt, or None for fixed exposures.
        betas: Adam decay rates.
        statistics: whether to collect ``table.statistics`` for density control.

    Attributes:
        views: fitted views.
        exposures: exposures of the views, or None.
        renderer: renderer of the engine.
        losses: loss of each iteration so far.
        psnr: PSNR of the rendered view in each iteration so far, in dB.

    >>> from scas4d_core.captures import open_capture
    >>> from scas4d_core.engines.choose import fit_engine_of, renderer_of
    >>> from scas4d_core.engines.limits import scene_limits
    >>> from scas4d_core.engines.fit import COLOUR
    >>> from scas4d_core.fit.initial_gaussians import initial_parameters
    >>> from scas4d_core.update.view_factory import ViewFactory
    >>> capture = open_capture("samples/robot", image_scale=0.25)
    >>> views = ViewFactory(capture.rig).views(capture.frame(0), {})
    >>> cloud, random = capture.points, np.random.default_rng(0)
    >>> table = initial_parameters(cloud.positions, cloud.colours, cloud.foreground, 500, random)
    >>> renderer = renderer_of("cpu", (0, 0, 0), scene_limits("auto", capture.rig.radius))
    >>> fit, rates = GaussianFit(fit_engine_of(renderer), views, table), np.zeros(15, np.float32)
    >>> rates[COLOUR] = 0.01
    >>> fit.run([0] * 20, lambda step: FitScalars(rates))
    >>> fit.losses[-1] < fit.losses[0], len(fit.state())
    (True, 500)
    """

    def __init__(
        self,
        engine: FitEngine,
        views: Sequence[TrainingView],
        parameters: Array,
        *,
        fixed: Sequence[Gaussians] = (),
        gloss: FitGloss | None = None,
        exposures: Exposures | None = None,
        betas: tuple[np.float32, np.float32] = (BETA1, BETA2),
        statistics: bool = False,
    ) -> None:
        self.views, self.exposures = views, exposures
        self.losses: list[float] = []
        self.psnr: list[float] = []
        self._engine, self.renderer = engine, engine.renderer
        self._engine.load_views(views, fixed)
        moments = np.zeros_like(parameters), np.zeros_like(parameters)
        kept = RenderingStatistics.empty(len(parameters)) if statistics else None
        self._count = len(parameters)
        self._engine.load_table(FitTable(parameters, *moments, *betas, statistics=kept, gloss=gloss))

    def __len__(self) -> int:
        return self._count

    @property
    def table(self) -> FitTable:
        """The current parameters, moments, statistics and gloss."""
        return self._engine.table()

    def state(self) -> Gaussians:
        """Returns the fitted Gaussians, without the fixed Gaussians. Labels are between 0 and 1."""
        return self._engine.state()

    def run(
        self,
        order: Iterable[int],
        scalars: Callable[[FitStep], FitScalars],
        begin: Callable[[int], FitStep | None] = each_once,
        end: Callable[[FitStep, FitLoss], bool] = never,
    ) -> None:
        """Runs iterations until the order of views is exhausted, or until ``begin`` or ``end`` ends the fit.

        Args:
            order: view index of each iteration.
            scalars: function that returns the learning rates and options of an iteration.
            begin: function called before each iteration, with the number of iterations done in this
                run. It returns the step of the iteration, or None to end the fit.
            end: function called after each iteration, with its step and its losses. It returns true
                to end the fit.
        """
        for done, view in enumerate(order):
            now = begin(done)
            if now is None:
                return
            last = self._engine.iterate(view, scalars(now))
            self.losses.append(last.loss)
            self.psnr.append(last.psnr)
            if self.exposures is not None:
                self.exposures.step(self.views[view], last.exposure_gradient, len(self.losses))
            if end(now, last):
                return

    def set_gloss(self, gloss: FitGloss) -> None:
        """Replaces the gloss of the current Gaussians for the rest of the fit."""
        self._engine.load_table(replace(self.table, gloss=gloss))

    def replace_rows(self, rows: NDArray[np.int64], added: Array, parents: NDArray[np.int64]) -> None:
        """Keeps some rows with their moments, and appends new rows with zero moments.

        Statistics are reset.

        Args:
            rows: indices of the rows to keep.
            added: [A, 15] parameters of the new rows.
            parents: [A] source row of each new row, from which it inherits its gloss.
        """
        table, fresh = self.table, np.zeros_like(added)
        gloss = None if table.gloss is None else table.gloss.select_rows(rows, parents)
        parameters, first, second = (
            np.concatenate([old[rows], new])
            for old, new in ((table.parameters, added), (table.first, fresh), (table.second, fresh))
        )
        self._count = len(parameters)
        kept = None if table.statistics is None else RenderingStatistics.empty(self._count)
        self._engine.load_table(
            replace(table, parameters=parameters, first=first, second=second, statistics=kept, gloss=gloss)
        )
