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
from scas4d_core.engines.cpu.gloss import GLOSS, Shading, without_turn
from scas4d_core.first_frame.fit_schedule import FitProgress, FitStep
from scas4d_core.first_frame.normals import surface_normals
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.first_frame.static_scene import StaticTrainer
from scas4d_core.first_frame.strengths import strengths_seen
from scas4d_core.kernels.adam import EVERY_ROW, adam

Array = NDArray[np.float32]

TRIAL = 0.15
"""Share of the iterations after which the trial is made: there is a surface, and little has been made up behind it."""
FEWEST_ITERATIONS = 100
"""Of a fit, from which a part of it can tell what colours alone will not explain."""
FEWEST_VIEWS = 12
"""For the trial: of fewer cameras each has highlights that no other sees beside it, and anything explains them."""
HURRIED = 1.5
"""Stride of the schedule from which there is no time for a trial: it takes as long as 350 of the iterations, and a
surface that came about in a hurry explains less (basketball in 600 iterations: 7 % for direction, in 3000 none)."""
ROUNDS = 8
"""Over all views, of the trial."""
LEARNT = 0.5
"""Share of the iterations up to which the environment is learnt on the first surface; then the fit begins anew."""
NORMALS_EVERY = 0.1
"""Share of the iterations between two estimates of the normals in that."""
SETTLED = 0.6
"""Share of the iterations after which normals are learnt; before, they are those of the first surface."""
SMOOTH_EVERY = 10
"""Iterations between two averages over neighbours."""


def fit_by_direction(
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
    losses = trainer.train(progress, trial.convinced)
    if trial.on:
        before, trainer = trial.learnt(), make()
        losses = GlossyFit(trainer, before).train(progress)
        trainer.schedule.shortened |= before.schedule.shortened
    found = {} if trial.evidence is None else {"direction": trial.evidence}
    shortened = ["no trial of colours that depend on direction"] if trial.untried else []
    return replace(trainer.result(losses), evidence=found, shortened=shortened)


def gloss_seen(trainer: StaticTrainer, environment: Array | None) -> tuple[Array, Array]:
    """[N, 3] normals times strengths of the surface that a fit has, and its means; without environment, the start's."""
    means, factors, opacities, _ = trainer.shapes()
    shape, views, rasterizer = (means, factors, opacities), trainer.views, trainer.loss.rasterizer
    normals = surface_normals(*shape, views, rasterizer)
    if environment is None:
        return GLOSS * normals, means
    return strengths_seen(normals, environment, *shape, views, rasterizer) * normals, means


class GlossTrial:
    """Finds whether colours depend on direction, on the surface of an unfinished fit.

    Args:
        trainer: of the fit. mode: "on" needs no evidence.

    Attributes:
        on: once asked. untried: whether there was no time for it.
        evidence: share of the residual that direction explains and colours alone do not; None: no trial was made.
    """

    def __init__(self, trainer: StaticTrainer, mode: Mode) -> None:
        self._trainer, self._mode = trainer, mode
        self.on = self.untried = False
        self.evidence: Evidence | None = None

    def convinced(self, now: FitStep) -> bool:
        """At the time of the trial, whether it speaks for direction; the fit is as it was."""
        if not now.reaches(max(1, round(TRIAL * self._trainer.settings.iterations))):
            return False
        few = len(self._trainer.views) < FEWEST_VIEWS or self._trainer.settings.iterations < FEWEST_ITERATIONS
        if (few or self._trainer.schedule.stride > HURRIED) and self._mode != "on":
            self.untried = not few
            return False
        gloss, means = gloss_seen(self._trainer, None)
        without, seen = self._left(None), self._left(Shading.fresh(gloss, means))
        share = max(0.0, 1 - seen / max(without, 1e-12))
        self.evidence = Evidence(share, f"explains {100 * share:.0f} % of the residual of frame 0")
        self.on = self._mode == "on" or share >= effect("direction").on_above
        return self.on

    def _left(self, shading: Shading | None) -> float:
        """Mean squared error of the pictures after a few rounds of colours, and of a shading."""
        trainer = self._trainer
        means, factors, opacities, features = trainer.shapes()
        colours, shown = np.ascontiguousarray(features[:, :3]), features.copy()
        moments, turns = np.zeros((2, *colours.shape), np.float32), without_turn(len(means))
        rates, beta1, beta2 = np.full(3, 2.5e-3, np.float32), np.float32(0.9), np.float32(0.999)
        errors: list[float] = []
        rasterizer = trainer.loss.rasterizer
        for number in range(ROUNDS * len(trainer.views)):
            view = trainer.views[number % len(trainer.views)]
            shown[:, :3] = colours
            if shading is not None:
                shading.show(means, turns, colours, view.camera, shown)
            trainer.loss.measure(means, factors, opacities, shown, view)
            # Those of colours alone: positions and shapes stay.
            gradients = rasterizer.feature_gradients(rasterizer.gradient_buffers()[0])
            errors.append(10 ** (-trainer.loss.psnr / 10))
            if shading is not None:
                shading.saw(means, turns, colours, view.camera, gradients)
                shading.step()
            pull = np.ascontiguousarray(gradients[:, :3])
            adam(colours, pull, moments[0], moments[1], rates, EVERY_ROW, beta1, beta2, number + 1)
        return float(np.mean(errors[-len(trainer.views) :]))

    def learnt(self) -> StaticTrainer:
        """The trainer once it has an environment, on the surface that it has."""
        trainer, whole, schedule = self._trainer, self._trainer.settings.iterations, self._trainer.schedule
        every, began = max(1, round(NORMALS_EVERY * whole)), schedule.at
        environment, estimates, schedule.again = None, 0, True
        schedule.end = max(schedule.at, float(round(LEARNT * whole)))
        while environment is None or schedule.at < round(LEARNT * whole):
            now = schedule.next()
            if now.begun - began >= estimates * every:
                estimates += 1
                gloss, means = gloss_seen(trainer, environment)
                trainer.shading = Shading.fresh(gloss, means, environment)
                environment = trainer.shading.environment
            trainer.step(trainer.views[int(trainer.random.integers(len(trainer.views)))], now.begun)
            schedule.took(len(trainer.parameters))
        return trainer


class GlossyFit:
    """The fit of frame 0 with the surface and the environment of another.

    Args:
        trainer: that has not begun. before: the other.
    """

    def __init__(self, trainer: StaticTrainer, before: StaticTrainer) -> None:
        assert before.shading is not None
        self._trainer = trainer
        gloss, means = gloss_seen(before, before.shading.environment)
        self._strengths = np.linalg.norm(gloss, axis=1, keepdims=True)
        self._tree, self._normals = cKDTree(means), gloss / np.maximum(self._strengths, 1e-9)
        trainer.shading = Shading.fresh(self._placed(None), means, before.shading.environment)

    def _placed(self, gloss: Array | None) -> Array:
        """[N, 3] gloss with the normals of the first surface; strengths as they are, at first those of it, too."""
        near = self._tree.query(self._trainer.parameters[:, :3], 6)[1]
        normals = self._normals[near].mean(axis=1)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        own = self._strengths[near].mean(axis=1) if gloss is None else np.linalg.norm(gloss, axis=1, keepdims=True)
        placed: Array = (own * normals).astype(np.float32)
        return placed

    def train(self, progress: Callable[[FitProgress], None] | None) -> list[float]:
        """Runs all iterations, see ``StaticTrainer.train``."""
        return self._trainer.train(progress, self._after)

    def _after(self, now: FitStep) -> bool:
        shading, share = self._trainer.shading, now.ended / self._trainer.settings.iterations
        assert shading is not None
        if share <= SETTLED and now.passes(100):
            shading.gloss[:] = self._placed(shading.gloss)
            shading.changed_from[:] = shading.gloss
        elif share > SETTLED and now.passes(SMOOTH_EVERY):
            shading.smooth(self._trainer.parameters[:, :3])
        return False
