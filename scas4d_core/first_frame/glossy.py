"""Fits frame 0 with glossy objects: a trial detects them, and a second fit models their reflections.

Without a gloss model, the fit reproduces the highlights in each camera's image with Gaussians off
the surface that only this camera sees. These Gaussians persist in later frames. An early trial
therefore checks whether colours depend on the viewing direction. If they do, the environment is
learnt on the current surface, and the fit restarts with this environment and surface.
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
"""Fraction of the iterations after which the trial runs. By then, the fit has found the surface, but
has added few Gaussians off the surface."""
MIN_ITERATIONS = 100
"""Minimum number of iterations of a fit with a trial. In a shorter fit, other errors dominate the
residual."""
MIN_VIEWS = 12
"""Minimum number of views for the trial. With fewer views, only one camera sees each highlight, and
any colour model explains the highlight."""
MAX_STRIDE = 1.5
"""Schedule stride above which there is no time for a trial, which takes as long as 350 iterations.
Moreover, the surface of a shortened fit explains less of the images, so view-dependent colours seem
to explain more. On basketball, they explain 7% of the residual after 600 iterations, but nothing
after 3000."""
ROUNDS = 8
"""Number of passes over all views in the trial."""
RATE = 2.5e-3
"""Adam learning rate of colours in the trial."""
LEARN_UNTIL = 0.5
"""Fraction of the iterations until which the environment is learnt on the first surface. The fit then
restarts."""
NORMALS_EVERY = 0.1
"""Interval between estimates of the normals while the environment is learnt, as a fraction of the iterations."""
LEARN_NORMALS_FROM = 0.6
"""Fraction of the iterations after which normals are learnt. Until then, the normals are repeatedly
reset to those of the first surface."""
SMOOTH_EVERY = 10
"""Interval, in iterations, at which changes of the gloss are averaged over neighbours while normals
are learnt."""


def fit_with_gloss_trial(
    make: Callable[[], StaticTrainer], mode: Mode, progress: Callable[[FitProgress], None] | None = None
) -> StaticResult:
    """Fits the Gaussians Θ_0 of frame 0, with view-dependent colours if the scene is glossy.

    Args:
        make: function that creates a new trainer.
        mode: whether to use view-dependent colours: "on", "off", or "auto" to decide with a trial.
        progress: function called after each iteration.
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
    shortened = ["no trial of view-dependent colours"] if trial.out_of_time else []
    return replace(trainer.result(losses), evidence=evidence, shortened=shortened)


def estimate_gloss(trainer: StaticTrainer, environment: Array | None) -> tuple[Array, Array]:
    """Returns each Gaussian's surface normal scaled by its gloss strength, [N, 3], and the Gaussian means.

    Without an environment, the initial gloss strength is used.
    """
    state, views, renderer = trainer.gaussians(), trainer.views, trainer.fit.renderer
    normals = surface_normals(state, views, renderer)
    if environment is None:
        return GLOSS * normals, state.means
    return estimate_strengths(normals, environment, state, views, renderer) * normals, state.means


class GlossTrial:
    """Trial that decides whether colours depend on the viewing direction.

    The trial uses the surface of an unfinished fit.

    Args:
        trainer: trainer of the fit.
        mode: "auto" to decide by evidence, or "on" to always use view-dependent colours.

    Attributes:
        on: whether to use view-dependent colours. The value is false before the trial.
        out_of_time: whether the trial was skipped for lack of time.
        evidence: fraction of the residual that view-dependent colours explain beyond constant
            colours, or None if the trial has not run.
    """

    def __init__(self, trainer: StaticTrainer, mode: Mode) -> None:
        self._trainer, self._mode = trainer, mode
        self.on = self.out_of_time = False
        self.evidence: Evidence | None = None

    def run_when_due(self, now: FitStep) -> bool:
        """Runs the trial if it is due, and returns whether a gloss model is needed.

        The trial does not change the fit.
        """
        if not now.reaches(max(1, round(TRIAL * self._trainer.settings.iterations))):
            return False
        few = len(self._trainer.views) < MIN_VIEWS or self._trainer.settings.iterations < MIN_ITERATIONS
        if (few or self._trainer.schedule.stride > MAX_STRIDE) and self._mode != "on":
            self.out_of_time = not few
            return False
        gloss, means = estimate_gloss(self._trainer, None)
        without, seen = self._remaining_error(None), self._remaining_error(GlossShading.fresh(gloss, means))
        share = max(0.0, 1 - seen / max(without, 1e-12))
        self.evidence = Evidence(share, f"view-dependent colour explains {100 * share:.0f}% of the residual of frame 0")
        self.on = self._mode == "on" or share >= effect("direction").on_above
        return self.on

    def _remaining_error(self, gloss: GlossShading | None) -> float:
        """Fits the colours, and the gloss if given, and returns the mean squared image error.

        The fit makes ``ROUNDS`` passes over all views. All other parameters are fixed.
        """
        trainer, rates = self._trainer, np.zeros(COLUMNS, np.float32)
        rates[COLOUR] = RATE
        parameters, cameras = trainer.fit.table.parameters.copy(), len(trainer.views)
        fit = GaussianFit(fit_engine_of(trainer.fit.renderer), trainer.views, parameters, gloss=gloss)
        fit.run(ROUNDS * list(range(cameras)), lambda now: FitScalars(rates))
        return float(np.mean([10 ** (-psnr / 10) for psnr in fit.psnr[-cameras:]]))

    def learn_environment(self) -> StaticTrainer:
        """Learns an environment on the trainer's current surface, and returns the trainer."""
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
    """Fit of frame 0 that starts with the surface normals and environment of a previous fit.

    Args:
        trainer: new trainer.
        before: trainer of the previous fit.
    """

    def __init__(self, trainer: StaticTrainer, before: StaticTrainer) -> None:
        assert before.fit.table.gloss is not None
        self._trainer, environment = trainer, before.fit.table.gloss.environment
        gloss, means = estimate_gloss(before, environment)
        self._strengths = np.linalg.norm(gloss, axis=1, keepdims=True)
        self._tree, self._normals = cKDTree(means), gloss / np.maximum(self._strengths, 1e-9)
        trainer.fit.set_gloss(GlossShading.fresh(self._with_first_normals(None), means, environment))

    def _with_first_normals(self, gloss: Array | None) -> Array:
        """Returns the gloss [N, 3] of the current Gaussians, with the normals of the first surface.

        Args:
            gloss: [N, 3] gloss from which the strengths are taken, or None to use the strengths of
                the first surface.
        """
        near = self._tree.query(self._trainer.fit.table.parameters[:, MEAN], 6)[1]
        normals = self._normals[near].mean(axis=1)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        own = self._strengths[near].mean(axis=1) if gloss is None else np.linalg.norm(gloss, axis=1, keepdims=True)
        placed: Array = (own * normals).astype(np.float32)
        return placed

    def train(self, progress: Callable[[FitProgress], None] | None) -> list[float]:
        """Runs all iterations; see ``StaticTrainer.train``."""
        return self._trainer.train(progress, self._after)

    def _after(self, now: FitStep) -> bool:
        share = now.ended / self._trainer.settings.iterations
        learns = share > LEARN_NORMALS_FROM
        if not now.passes(SMOOTH_EVERY if learns else 100):
            return False
        table = self._trainer.fit.table
        shading = table.gloss
        assert isinstance(shading, GlossShading)
        if learns:
            shading.smooth(table.parameters[:, MEAN])
        else:
            shading.gloss[:] = self._with_first_normals(shading.gloss)
            shading.changed_from[:] = shading.gloss
        self._trainer.fit.set_gloss(shading)
        return False
