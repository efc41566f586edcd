"""Frame 0: 3D Gaussian Splatting with adaptive density control (Kerbl et al. 2023), under a budget of Gaussians."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.cpu.gloss import Shading, without_turn
from scas4d_core.engines.cpu.renderer import CpuRenderer
from scas4d_core.engines.limits import scene_limits
from scas4d_core.engines.views import TrainingView
from scas4d_core.first_frame.exposures import TRIAL, Exposures
from scas4d_core.first_frame.fit_schedule import FitProgress, FitSchedule, FitStep
from scas4d_core.first_frame.initial_gaussians import (
    COLOUR,
    LABEL,
    MEAN,
    OPACITY,
    QUATERNION,
    SCALE,
    budget,
    initial_parameters,
)  # fmt: skip
from scas4d_core.first_frame.points.surroundings import Stage
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.first_frame.time_limit import TimeLimit
from scas4d_core.gaussians import Gaussians
from scas4d_core.kernels import activation
from scas4d_core.kernels.adam import EVERY_ROW, adam
from scas4d_core.settings import SceneSettings, StaticSettings
from scas4d_core.update.result import CameraFit, camera_fit
from scas4d_core.update.schedule import view_order
from scas4d_core.update.view_factory import ViewFactory

Array = NDArray[np.float32]

BETA1, BETA2 = np.float32(0.9), np.float32(0.999)
INITIAL_SHARE = 0.6
"""Share of the budget that the first cloud may take; of a larger cloud a random part is taken."""
DENSIFY_FROM = 200
"""First iteration that densifies; before, gradients are noise."""
DENSIFY_EVERY = 100
"""Iterations between densifications (3DGS)."""
DENSIFY_UNTIL = 0.6
"""Share of the iterations after which none is added: the rest settles what is there."""
DENSIFY_GRADIENT = 1e-6
"""Mean screen gradient (per half picture, as in 3DGS) above which a Gaussian may be refined; the budget decides how
many are, hardest pulled first."""
PRUNE_OPACITY = 0.01
"""Less opaque Gaussians are removed while densifying."""
MIN_VIEWS = 2
"""Gaussians that fewer training cameras than this see are removed."""
SEEN_PIXELS = 0.05
"""Pixels' worth of blending weight from which a camera counts as seeing a Gaussian."""
RATE_POSITION, RATE_POSITION_END = 1.6e-4, 1.6e-6
"""Adam rates of means at the start and at the end, per metre of scene radius; the decay is exponential (3DGS)."""
RATE_COLOUR, RATE_OPACITY, RATE_SCALE, RATE_ROTATION, RATE_EXPOSURE = 2.5e-3, 5e-2, 5e-3, 2e-3, 1e-3
"""Adam rates of colours, opacity logits, log scales, quaternions (those of 3DGS, rotation doubled), and of the cameras'
gain and offset."""
WEIGHT_MASK = 3.0
"""Weight of the mask loss where masks are given; in frame 0 it teaches the labels only."""
SPLIT_SHRINK = 1.6
"""A split Gaussian's halves are smaller by this (3DGS)."""
STOP_ROUNDS = 5
"""Rounds over all views that the stop rule compares with as many before: in fewer the order of views is noise."""


class StaticTrainer:
    """Fits Gaussians to the views of one frame."""

    def __init__(
        self,
        factory: ViewFactory,
        views: list[TrainingView],
        parameters: Array,
        scene: SceneSettings,
        settings: StaticSettings,
        limit: TimeLimit | None = None,
        stage: Stage | None = None,
    ) -> None:
        self.settings = settings
        self.views = views
        self.parameters = parameters
        self.budget = budget(views, scene, settings)
        self.shading: Shading | None = None
        self.stage = stage
        self.radius = factory.rig.radius
        limits = scene_limits(scene.near, self.radius)
        self.loss = CpuRenderer(scene.behind, 1.0, WEIGHT_MASK, False, limits)
        self._masked = any(len(view.target) > 3 for view in views)
        self.random = np.random.default_rng(settings.seed)
        self._reset_moments()
        self.exposures = Exposures(views, settings.exposure is not False, RATE_EXPOSURE, BETA1, BETA2)
        self.psnr: list[float] = []
        self._last, self._steps = float(settings.iterations), 0
        self.cameras: dict[str, CameraFit] = {}
        self._start, self._until = len(parameters), int(DENSIFY_UNTIL * settings.iterations)
        self.schedule = FitSchedule(settings.iterations, limit or TimeLimit(None), self._expected)

    def shapes(self) -> tuple[Array, Array, Array, Array]:
        """Means, factors, opacities and features of the parameters as they are."""
        count = len(self.parameters)
        found = [np.empty(shape, np.float32) for shape in ((count, 3), (count, 3, 3), (count,), (count, 4))]
        activation.activate(self.parameters, *found)
        return found[0], found[1], found[2], found[3]

    def _reset_moments(self) -> None:
        count = len(self.parameters)
        self._first = np.zeros_like(self.parameters)
        self._second = np.zeros_like(self.parameters)
        self._screen = np.zeros(count)
        self._seen = np.zeros(count, np.int64)

    def _allocate(self) -> None:
        count = len(self.parameters)
        self._means = np.empty((count, 3), np.float32)
        self._factors = np.empty((count, 3, 3), np.float32)
        self._opacities = np.empty(count, np.float32)
        self._features = np.empty((count, 4), np.float32)
        self._gradients = np.empty_like(self.parameters)

    def train(
        self, progress: Callable[[FitProgress], None] | None = None, enough: Callable[[FitStep], bool] | None = None
    ) -> list[float]:
        """Runs all iterations, or fewer by the stop rule or for want of time.

        Args:
            progress: called after each iteration. enough: called after each; True ends the fit.
        """
        settings, schedule, until = self.settings, self.schedule, self._until
        losses: list[float] = []
        self._allocate()
        for index in view_order(len(self.views), settings.iterations, self.random):
            now = schedule.next()
            losses.append(self.step(self.views[index], now.begun))
            if now.ended >= DENSIFY_FROM and now.begun < until and now.passes(DENSIFY_EVERY):
                self.control_density(self._target(now.ended))
            if now.reaches(until) or now.reaches((until + settings.iterations) // 2):
                self.remove_unseen()
            if now.ended > until and self._last == settings.iterations and self._settled(losses):
                self._last = min(self._last, now.ended + len(self.views) * schedule.stride)
                self.remove_unseen()
            if settings.exposure == "auto" and now.reaches(round(TRIAL * settings.iterations)):
                self.exposures.assess()
            schedule.took(len(self.parameters))
            if progress is not None:
                progress(FitProgress(schedule.done, schedule.total, losses[-1], schedule.seconds))
            if now.ended >= self._last or (enough is not None and enough(now)):
                break
        return losses

    def _target(self, at: float) -> int:
        """Gaussians that density control aims at, at a moment of the schedule."""
        share = (at - DENSIFY_FROM) / max(self._until - DENSIFY_FROM, 1)
        return round(self._start + (self.budget - self._start) * min(1.0, share + 0.1))

    def _expected(self, at: float) -> float:
        """Gaussians at a moment of the schedule: of this fit where it is to come, else of another one like it."""
        aim, now = self._target(min(at, self._until)) if at >= DENSIFY_FROM else self._start, self.schedule.at
        return aim if at < now else len(self.parameters) if now >= self._until else max(len(self.parameters), aim)

    def _settled(self, losses: list[float]) -> bool:
        """True once rounds over all views no longer lower the loss; one more round of them follows."""
        window = STOP_ROUNDS * len(self.views)
        if self.settings.stop_gain == 0 or len(losses) % window or len(losses) < 2 * window:
            return False
        before, now = np.mean(losses[-2 * window : -window]), np.mean(losses[-window:])
        return bool(before - now < self.settings.stop_gain * before)

    def step(self, view: TrainingView, at: float) -> float:
        """One iteration, at a moment of the schedule: renders the view, carries the gradient back, steps Adam.

        Returns the loss.
        """
        activation.activate(self.parameters, self._means, self._factors, self._opacities, self._features)
        if self.shading is not None:
            turns, colours = without_turn(len(self._means)), self._features[:, :3].copy()
            self.shading.show(self._means, turns, colours, view.camera, self._features)
        gradients = self.loss.evaluate(self._means, self._factors, self._opacities, self._features, view)
        if self.shading is not None:
            self.shading.saw(self._means, turns, colours, view.camera, gradients.features)
            self.shading.step(1 - 0.9 * at / self.settings.iterations)
        self.psnr.append(self.loss.psnr)
        # A shorter fit ends somewhere in a round: two hold every view.
        if at >= self._last - len(self.views) * (1 if self.schedule.stride == 1 else 2 * self.schedule.stride):
            self.cameras[view.name] = camera_fit(self.loss.psnr, self.loss.colour_shift(view))
        activation.activate_backward(
            self.parameters, self._factors, self._opacities, self._features, gradients.means, gradients.factors,
            gradients.opacities, gradients.features, self._gradients,
        )  # fmt: skip
        width = np.array([view.camera.width / 2, view.camera.height / 2], np.float32)
        visible = self.loss.rasterizer.counts > 0
        self._screen += np.sqrt(np.square(gradients.screen * width).sum(axis=1))
        self._seen += visible
        self._steps += 1
        adam(
            self.parameters, self._gradients, self._first, self._second, self._rates(at), EVERY_ROW, BETA1, BETA2,
            self._steps,
        )  # fmt: skip
        self.exposures.step(view, self.loss.exposure_gradient, self._steps)
        return self.loss.image_part + self.loss.mask_part

    def _rates(self, at: float) -> Array:
        share = at / max(self.settings.iterations - 1, 1)
        position = RATE_POSITION ** (1 - share) * RATE_POSITION_END**share
        rates = np.empty(activation.COLUMNS, np.float32)
        rates[MEAN] = position * self.radius
        rates[QUATERNION] = RATE_ROTATION
        rates[SCALE] = RATE_SCALE
        rates[OPACITY] = RATE_OPACITY
        rates[COLOUR] = RATE_COLOUR
        rates[LABEL] = RATE_OPACITY if self._masked else 0.0
        return rates

    def control_density(self, target: int) -> None:
        """Removes Gaussians that are all but transparent; clones or splits those with the largest screen gradients.

        Args:
            target: number of Gaussians to reach.
        """
        opacity = 1 / (1 + np.exp(-self.parameters[:, 10]))
        score = self._screen / np.maximum(self._seen, 1)
        keep = opacity >= min(PRUNE_OPACITY, float(np.median(opacity)))  # never more than half at once
        room = max(0, min(target, self.budget) - int(keep.sum()))
        score = np.where(keep & (score >= DENSIFY_GRADIENT), score, 0)
        chosen = np.argsort(-score, kind="stable")[: min(room, int((score > 0).sum()))]
        largest = self.parameters[:, SCALE].max(axis=1)
        median = np.median(largest[keep])
        split = chosen[largest[chosen] > median]
        clone = chosen[largest[chosen] <= median]
        halves = [self._half(split), self._half(split)]
        keep[split] = False
        self._take(np.flatnonzero(keep), [self.parameters[clone], *halves], [clone, split, split])

    def remove_unseen(self) -> None:
        """Removes Gaussians that fewer than ``MIN_VIEWS`` cameras see.

        A Gaussian that no camera sees is free to be anything and shows once the scene moves; one that a single camera
        sees is a floater that explains this camera's picture and spoils all others.
        """
        counts = np.zeros(len(self.parameters), np.int64)
        state = self.gaussians()
        for view in self.views:
            everywhere = np.ones((1, view.camera.height, view.camera.width), np.float32)
            counts += self.loss.gather(state, view.camera, everywhere)[:, 0] > SEEN_PIXELS
        needed = np.full(len(counts), min(MIN_VIEWS, len(self.views)))
        if self.stage is not None:  # surroundings hide nothing from others
            needed[~self.stage.holds(self._means)] = 1
        keep = counts >= needed
        if keep.any():
            self._take(np.flatnonzero(keep), [], [])

    def _take(self, rows: NDArray[np.int64], added: list[Array], parents: list[NDArray[np.int64]]) -> None:
        """Keeps some rows with their moments and appends others with none; ``parents``: the rows these come from."""
        if self.shading is not None:
            self.shading = self.shading.taken(rows, np.concatenate([rows[:0], *parents]))
        fresh = np.zeros((sum(map(len, added)), activation.COLUMNS), np.float32)
        first = np.concatenate([self._first[rows], fresh])
        second = np.concatenate([self._second[rows], fresh])
        self.parameters = np.ascontiguousarray(np.concatenate([self.parameters[rows], *added]))
        self._reset_moments()
        self._first, self._second = first, second
        self._allocate()

    def _half(self, rows: NDArray[np.int64]) -> Array:
        """The rows with smaller scales, each displaced by a sample of its own Gaussian."""
        half = self.parameters[rows].copy()
        offset = self.random.standard_normal((len(rows), 3)).astype(np.float32)
        half[:, MEAN] += np.einsum("nij,nj->ni", self._factors[rows], offset)
        half[:, SCALE] -= np.log(SPLIT_SHRINK)
        return half

    def gaussians(self) -> Gaussians:
        """The state Θ_0; without masks every Gaussian may move."""
        shading = self.shading
        self._allocate()
        activation.activate(self.parameters, self._means, self._factors, self._opacities, self._features)
        count = len(self.parameters)
        return Gaussians(
            means=self._means.copy(),
            factors=self._factors.copy(),
            rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
            opacities=self._opacities.copy(),
            colours=self._features[:, :3].copy(),
            foreground=self._features[:, 3].copy() if self._masked else np.ones(count, np.float32),
            ids=np.arange(count, dtype=np.int64),
            gloss=None if shading is None else shading.gloss.copy(),
            environment=None if shading is None else shading.environment.copy(),
        )

    def result(self, losses: list[float]) -> StaticResult:
        """Of the iterations so far."""
        found, planned = self.exposures.found(), self.schedule.record
        return StaticResult(
            self.gaussians(), found, losses, self.psnr, self.cameras, planned=planned, hurried=self.schedule.shortened
        )


def first_trainer(
    factory: ViewFactory,
    views: list[TrainingView],
    positions: NDArray[np.float64],
    colours: Array,
    foreground: Array | None,
    scene: SceneSettings,
    settings: StaticSettings,
    limit: TimeLimit | None = None,
    stage: Stage | None = None,
) -> StaticTrainer:
    """The trainer of ``start.fit_static_scene``, before its first iteration; arguments and errors are the same.

    ``stage``: inside world, that surroundings lie beyond, which one camera alone may see; None without these.
    """
    if len(positions) == 0:
        raise ValueError("the first cloud holds no point; give points, masks, or more overlapping cameras")
    rng = np.random.default_rng(settings.seed)
    most = max(1, int(INITIAL_SHARE * budget(views, scene, settings)))
    parameters = initial_parameters(positions, colours, foreground, most, rng)
    return StaticTrainer(factory, views, parameters, scene, settings, limit, stage)
