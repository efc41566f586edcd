"""The one loop that fits Gaussians to pictures outside an update: in frame 0, when things are born, while they settle.

What differs between these is given to ``GaussianFit.run``: the order of the views, the rates of each iteration, where
the schedule begins an iteration or ends the fit, and what is done after an iteration.
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
"""Adam's decays, unless others are given: those of 3DGS."""


@dataclass(frozen=True)
class FitStep:
    """One iteration, in iterations of the full schedule: from ``begun`` to ``ended``.

    >>> step = FitStep(99.0, 101.5)
    >>> step.reaches(100), step.reaches(102), step.passes(100), step.passes(70)
    (True, False, True, False)
    """

    begun: float
    ended: float

    def reaches(self, moment: float) -> bool:
        """True where this iteration reaches a moment of the schedule."""
        return self.begun < moment <= self.ended

    def passes(self, every: float) -> bool:
        """True where this iteration passes a multiple of ``every``."""
        return self.ended // every > self.begun // every


def each_once(done: int) -> FitStep:
    """The schedule of a fit that makes every iteration in full: iteration ``done``, counted from 0."""
    return FitStep(done, done + 1)


def never(now: FitStep, last: FitLoss) -> bool:
    """Ends no fit before its order of views is through."""
    return False


class GaussianFit:
    """Fits the rows of a table of parameters to views.

    Args:
        engine: of this fit alone. views: that are fitted.
        parameters: [N, 15], columns as of ``engines.fit``; changed in place.
        fixed: for each view, Gaussians that are drawn with the fitted ones and stay as they are; empty: none.
        gloss: with which colours depend on direction, learnt as well.
        exposures: of the views, learnt as well.
        betas: Adam's decays. statistics: whether density control will ask for ``table.statistics``.

    Attributes:
        views, exposures: as given. renderer: of the engine.
        losses, psnr: of each iteration so far; dB of the view that it rendered.

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
        """Parameters, moments, statistics and gloss as they are now."""
        return self._engine.table()

    def state(self) -> Gaussians:
        """The fitted Gaussians, without the fixed ones; their labels are between 0 and 1."""
        return self._engine.state()

    def run(
        self,
        order: Iterable[int],
        scalars: Callable[[FitStep], FitScalars],
        begin: Callable[[int], FitStep | None] = each_once,
        end: Callable[[FitStep, FitLoss], bool] = never,
    ) -> None:
        """Run iterations until the order of views is through, or ``begin`` or ``end`` says that the fit is over.

        Args:
            order: index of the view of each iteration. scalars: rates of an iteration.
            begin: called before an iteration with the number of those of this run; None ends the fit.
            end: called after an iteration with its loss; True ends the fit.
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
        """Continue with another gloss of the same Gaussians."""
        self._engine.load_table(replace(self.table, gloss=gloss))

    def replace_rows(self, rows: NDArray[np.int64], added: Array, parents: NDArray[np.int64]) -> None:
        """Keep some rows with their moments, and append others without; the statistics begin anew.

        Args:
            added: [A, 15] parameters. parents: [A] rows that these come from, whose gloss they inherit.
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
