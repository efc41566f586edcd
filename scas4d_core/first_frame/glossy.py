"""Frame 0 of glossy things: whether there are any, and the fit with what they mirror.

Left alone, a fit explains each camera's highlights by Gaussians that only this camera sees, behind or before the
surface, and they stay in what follows. So where a trial, early in the fit, finds that colours depend on direction, the
environment is learnt on the surface found so far, and the fit begins anew with both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scas4d_core.effect_names import Mode
from scas4d_core.effects.effect import effect
from scas4d_core.effects.evidence import Evidence
from scas4d_core.engines.choose import fit_engine_of
from scas4d_core.engines.cpu.gloss import GLOSS, GlossShading
from scas4d_core.engines.fit import COLOUR, COLUMNS, MEAN, FitLoss, FitScalars
from scas4d_core.first_frame.fit_schedule import FitProgress
from scas4d_core.first_frame.gloss_strengths import estimate_strengths
from scas4d_core.first_frame.normals import surface_normals
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.first_frame.static_scene import StaticTrainer
from scas4d_core.fit.gaussian_fit import FitStep, GaussianFit

Array = NDArray[np.float32]

TRIAL = 0.15
"""Share of the iterations after which the trial is made: there is a surface, and little has been made up behind it."""
MIN_ITERATIONS = 100
"""Of a fit, after which its residual shows what colours alone will not explain."""
MIN_VIEWS = 12
"""For the trial: of fewer cameras each has highlights that no other sees beside it, and anything explains them."""
MAX_STRIDE = 1.5
"""Stride of the schedule from which there is no time for a trial: it takes as long as 350 of the iterations, and a
surface that came about in a hurry explains less (basketball in 600 iterations: 7 % for direction, in 3000 none)."""
ROUNDS = 8
"""Over all views, of the trial."""
RATE = 2.5e-3
"""Adam's rate of colours in the trial."""
LEARN_UNTIL = 0.5
"""Share of the iterations up to which the environment is learnt on the first surface; then the fit begins anew."""
NORMALS_EVERY = 0.1
"""Share of the iterations between two estimates of the normals in that."""
LEARN_NORMALS_FROM = 0.6
"""Share of the iterations after which normals are learnt; before, they are those of the first surface."""
SMOOTH_EVERY = 10
"""Iterations between two averages over neighbours."""


def fit_with_gloss_trial(
    make: Callable[[], StaticTrainer], mode: Mode, progress: Callable[[FitProgress], None] | None = None
) -> StaticResult:
    """Fits Θ_0 with colours that depend on direction, where that is called for.

    Args:
        make: the trainer of the fit, before its first iteration. mode: "auto": where a trial says so.
        progress: called after each iteration.
    """
    trainer = make()
    if mode == "off":
        return trainer.result(trainer.train(progress))
    trial = GlossTrial(trainer, mode)
    losses = trainer.train(progress, trial.run_when_due)
    if trial.on:
        before, trainer = trial.learn_environment(), make()
        losses = GlossyFit(trainer, before).train(progress)
        trainer.schedule.shortened |= before.schedule.shortened
    evidence = {} if trial.evidence is None else {"direction": trial.evidence}
    shortened = ["no trial of colours that depend on direction"] if trial.out_of_time else []
    return replace(trainer.result(losses), evidence=evidence, shortened=shortened)


def estimate_gloss(trainer: StaticTrainer, environment: Array | None) -> tuple[Array, Array]:
    """[N, 3] normals times strengths of the surface that a fit has, and its means; without environment, the start's."""
    state, views, renderer = trainer.gaussians(), trainer.views, trainer.fit.renderer
    normals = surface_normals(state, views, renderer)
    if environment is None:
        return GLOSS * normals, state.means
    return estimate_strengths(normals, environment, state, views, renderer) * normals, state.means


class GlossTrial:
    """Finds whether colours depend on direction, on the surface of an unfinished fit.

    Args:
        trainer: of the fit. mode: "on" needs no evidence.

    Attributes:
        on: once asked. out_of_time: whether there was no time for it.
        evidence: share of the residual that direction explains and colours alone do not; None: no trial was made.
    """

    def __init__(self, trainer: StaticTrainer, mode: Mode) -> None:
        self._trainer, self._mode = trainer, mode
        self.on = self.out_of_time = False
        self.evidence: Evidence | None = None

    def run_when_due(self, now: FitStep) -> bool:
        """At the time of the trial, whether it speaks for direction; the fit is as it was."""
        if not now.reaches(max(1, round(TRIAL * self._trainer.settings.iterations))):
            return False
        few = len(self._trainer.views) < MIN_VIEWS or self._trainer.settings.iterations < MIN_ITERATIONS
        if (few or self._trainer.schedule.stride > MAX_STRIDE) and self._mode != "on":
            self.out_of_time = not few
            return False
        gloss, means = estimate_gloss(self._trainer, None)
        without, seen = self._remaining_error(None), self._remaining_error(GlossShading.fresh(gloss, means))
        share = max(0.0, 1 - seen / max(without, 1e-12))
        self.evidence = Evidence(share, f"explains {100 * share:.0f} % of the residual of frame 0")
        self.on = self._mode == "on" or share >= effect("direction").on_above
        return self.on

    def _remaining_error(self, gloss: GlossShading | None) -> float:
        """Mean squared error of the pictures after a few rounds in which colours, and a gloss, learn alone."""
        trainer, rates = self._trainer, np.zeros(COLUMNS, np.float32)
        rates[COLOUR] = RATE
        parameters, cameras = trainer.fit.table.parameters.copy(), len(trainer.views)
        fit = GaussianFit(fit_engine_of(trainer.fit.renderer), trainer.views, parameters, gloss=gloss)
        fit.run(ROUNDS * list(range(cameras)), lambda now: FitScalars(rates))
        return float(np.mean([10 ** (-psnr / 10) for psnr in fit.psnr[-cameras:]]))

    def learn_environment(self) -> StaticTrainer:
        """The trainer once it has an environment, on the surface that it has."""
        trainer, whole, schedule = self._trainer, self._trainer.settings.iterations, self._trainer.schedule
        every, began, until = max(1, round(NORMALS_EVERY * whole)), schedule.at, float(round(LEARN_UNTIL * whole))
        estimates, schedule.fits_again = 0, True
        schedule.end = max(schedule.at, until)

        def begin(done: int) -> FitStep | None:
            nonlocal estimates
            if estimates and schedule.at >= until:
                return None
            now = schedule.begin_iteration()
            if now.begun - began >= estimates * every:
                estimates += 1
                before = trainer.fit.table.gloss
                environment = None if before is None else before.environment
                gloss, means = estimate_gloss(trainer, environment)
                trainer.fit.set_gloss(GlossShading.fresh(gloss, means, environment))
            return now

        def end(now: FitStep, last: FitLoss) -> bool:
            schedule.end_iteration(len(trainer.fit))
            return False

        views = len(trainer.views)
        without_end = iter(lambda: int(trainer.random.integers(views)), -1)
        trainer.fit.run(without_end, trainer.scalars, begin, end)
        return trainer


class GlossyFit:
    """The fit of frame 0 with the surface and the environment of another.

    Args:
        trainer: that has not begun. before: the other.
    """

    def __init__(self, trainer: StaticTrainer, before: StaticTrainer) -> None:
        assert before.fit.table.gloss is not None
        self._trainer, environment = trainer, before.fit.table.gloss.environment
        gloss, means = estimate_gloss(before, environment)
        self._strengths = np.linalg.norm(gloss, axis=1, keepdims=True)
        self._tree, self._normals = cKDTree(means), gloss / np.maximum(self._strengths, 1e-9)
        trainer.fit.set_gloss(GlossShading.fresh(self._with_first_normals(None), means, environment))

    def _with_first_normals(self, gloss: Array | None) -> Array:
        """[N, 3] gloss with the normals of the first surface; strengths as they are, at first those of it, too."""
        near = self._tree.query(self._trainer.fit.table.parameters[:, MEAN], 6)[1]
        normals = self._normals[near].mean(axis=1)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        own = self._strengths[near].mean(axis=1) if gloss is None else np.linalg.norm(gloss, axis=1, keepdims=True)
        placed: Array = (own * normals).astype(np.float32)
        return placed

    def train(self, progress: Callable[[FitProgress], None] | None) -> list[float]:
        """Runs all iterations, see ``StaticTrainer.train``."""
        return self._trainer.train(progress, self._after)

    def _after(self, now: FitStep) -> bool:
        shading, share = self._trainer.fit.table.gloss, now.ended / self._trainer.settings.iterations
        assert isinstance(shading, GlossShading)
        if share <= LEARN_NORMALS_FROM and now.passes(100):
            shading.gloss[:] = self._with_first_normals(shading.gloss)
            shading.changed_from[:] = shading.gloss
        elif share > LEARN_NORMALS_FROM and now.passes(SMOOTH_EVERY):
            shading.smooth(self._trainer.fit.table.parameters[:, MEAN])
        else:
            return False
        self._trainer.fit.set_gloss(shading)
        return False
