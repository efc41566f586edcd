"""Frame 0: 3D Gaussian Splatting (Kerbl et al. 2023) with adaptive density control and a Gaussian budget."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.choose import Device, fit_engine_of, renderer_of
from scas4d_core.engines.fit import (
    COLOUR,
    COLUMNS,
    LABEL,
    MEAN,
    OPACITY,
    QUATERNION,
    SCALE,
    FitLoss,
    FitScalars,
)  # fmt: skip
from scas4d_core.engines.limits import scene_limits
from scas4d_core.engines.renderer import pair_counts
from scas4d_core.engines.views import TrainingView
from scas4d_core.first_frame.fit_schedule import FitProgress, FitSchedule
from scas4d_core.first_frame.points.surroundings import Stage
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.first_frame.time_limit import TimeLimit
from scas4d_core.fit.exposures import TRIAL, Exposures
from scas4d_core.fit.gaussian_fit import BETA1, BETA2, FitStep, GaussianFit
from scas4d_core.fit.initial_gaussians import budget, initial_parameters
from scas4d_core.gaussians import Gaussians
from scas4d_core.settings import SceneSettings, StaticSettings
from scas4d_core.update.result import CameraFit, camera_fit
from scas4d_core.update.schedule import view_order
from scas4d_core.update.view_factory import ViewFactory

Array = NDArray[np.float32]

INITIAL_SHARE = 0.6
"""Maximum fraction of the Gaussian budget that the initial points use. A larger cloud is subsampled at
random."""
DENSIFY_FROM = 200
"""First iteration with densification. Earlier gradients are too noisy."""
DENSIFY_EVERY = 100
"""Number of iterations between densification steps, as in 3DGS."""
DENSIFY_UNTIL = 0.6
"""Fraction of the iterations after which no Gaussians are added, so that the existing ones can converge."""
DENSIFY_GRADIENT = 1e-6
"""Minimum mean screen-space gradient (per half image, as in 3DGS) for densifying a Gaussian. The budget
limits the number of densified Gaussians. Gaussians with the largest gradients are densified first."""
PRUNE_OPACITY = 0.01
"""Opacity below which densification removes a Gaussian."""
DEEP, DEEP_SHRINK = 52.0, 0.89
"""Mean number of Gaussians blended into a pixel (see ``pair_counts``) above which a scene is deep, and the
factor on all scales in a densification step. Once a step finds a scene deep, this and all later steps shrink
its Gaussians. Where few cameras constrain a scene, large and faint Gaussians would otherwise form deep stacks
and slow down updates (docs/real-captures.md). Rooms with 25 to 40 Gaussians per pixel and a capture with 48
would lose accuracy (docs/tried.md)."""
MIN_VIEWS = 2
"""Number of training cameras that must see a Gaussian. A Gaussian that fewer cameras see is removed."""
SEEN_PIXELS = 0.05
"""Blending weight, in pixels, above which a camera is considered to see a Gaussian."""
RATE_POSITION, RATE_POSITION_END = 1.6e-4, 1.6e-6
"""Adam learning rates of means at the start and at the end of the fit, per metre of rig radius. The
rate decays exponentially, as in 3DGS."""
RATE_COLOUR, RATE_OPACITY, RATE_SCALE, RATE_ROTATION, RATE_EXPOSURE = 2.5e-3, 5e-2, 5e-3, 2e-3, 1e-3
"""Adam learning rates of colours, opacity logits, log scales, quaternions, and the cameras' gain and
offset. The values are those of 3DGS, but twice as large for quaternions. 3DGS has no gain and
offset."""
WEIGHT_MASK = 3.0
"""Weight of the mask loss if there are masks. In frame 0, the mask loss only trains the labels."""
SPLIT_SHRINK = 1.6
"""Factor by which the scales of a Gaussian are divided when it is split in two, as in 3DGS."""
STOP_ROUNDS = 5
"""Number of passes over all views that the stopping rule averages. The rule compares the mean loss of
these passes with the mean loss of the same number of passes before. Fewer passes are too noisy."""


class StaticTrainer:
    """Trainer that fits Gaussians to the views of frame 0, with density control.

    Attributes:
        fit: training loop and its parameters.
        schedule: iteration schedule of the fit.
        exposures: exposures of the views, learnt in place.
        budget: maximum number of Gaussians.
        cameras: how well each camera's image was fitted in its last iteration, keyed by camera name.
    """

    def __init__(
        self,
        factory: ViewFactory,
        views: list[TrainingView],
        parameters: Array,
        scene: SceneSettings,
        settings: StaticSettings,
        limit: TimeLimit | None = None,
        stage: Stage | None = None,
        device: Device = "cpu",
    ) -> None:
        self.settings, self.views, self.stage = settings, views, stage
        self.budget = budget(views, scene, settings)
        self.radius = factory.rig.radius
        self._masked = any(len(view.target) > 3 for view in views)
        self.random = np.random.default_rng(settings.seed)
        self.exposures = Exposures(views, settings.exposure is not False, RATE_EXPOSURE, BETA1, BETA2)
        renderer = renderer_of(device, scene.background_rgb, scene_limits(scene.near, self.radius))
        engine = fit_engine_of(renderer, WEIGHT_MASK)
        self.fit = GaussianFit(engine, views, parameters, exposures=self.exposures, statistics=True)
        self._last, self._deep = float(settings.iterations), False
        self.cameras: dict[str, CameraFit] = {}
        self._start, self._until = len(parameters), int(DENSIFY_UNTIL * settings.iterations)
        self.schedule = FitSchedule(settings.iterations, limit or TimeLimit(None), self._expected)

    def train(
        self,
        progress: Callable[[FitProgress], None] | None = None,
        should_stop: Callable[[FitStep], bool] | None = None,
    ) -> list[float]:
        """Runs all iterations, or fewer if the stopping rule or the time limit applies, and returns their losses.

        Args:
            progress: function called after each iteration.
            should_stop: function called after each iteration; the fit ends if it returns true.
        """
        schedule = self.schedule

        def end(now: FitStep, last: FitLoss) -> bool:
            self._after(now, last)
            if progress is not None:
                progress(FitProgress(schedule.done, schedule.total, last.loss, schedule.seconds))
            return now.ended >= self._last or (should_stop is not None and should_stop(now))

        order = view_order(len(self.views), self.settings.iterations, self.random)
        self.fit.run(order, self.scalars, lambda done: schedule.begin_iteration(), end)
        return self.fit.losses

    def _after(self, now: FitStep, last: FitLoss) -> None:
        """Ends an iteration: records the fit of its view, and takes all steps that are due.

        The possible steps are density control, removal of Gaussians that are hardly seen, the
        stopping rule, and the exposure check.
        """
        settings, schedule, until = self.settings, self.schedule, self._until
        if last.colour_shift is not None:
            self.cameras[self.views[last.view].name] = camera_fit(last.psnr, last.colour_shift)
        if now.ended >= DENSIFY_FROM and now.begun < until and now.passes(DENSIFY_EVERY):
            self.control_density(self._target(now.ended))
        if now.reaches(until) or now.reaches((until + settings.iterations) // 2):
            self.remove_unseen()
        if now.ended > until and self._last == settings.iterations and self._has_converged():
            self._last = min(self._last, now.ended + len(self.views) * schedule.stride)
            self.remove_unseen()
        if settings.exposure == "auto" and now.reaches(round(TRIAL * settings.iterations)):
            self.exposures.assess()
        schedule.end_iteration(len(self.fit))

    def _target(self, at: float) -> int:
        """Returns the target number of Gaussians at a given point of the schedule."""
        share = (at - DENSIFY_FROM) / max(self._until - DENSIFY_FROM, 1)
        return round(self._start + (self.budget - self._start) * min(1.0, share + 0.1))

    def _expected(self, at: float) -> float:
        """Returns the expected number of Gaussians at a given point of the schedule.

        A point before the current position refers to a second fit, which starts from the beginning.
        """
        aim, now = self._target(min(at, self._until)) if at >= DENSIFY_FROM else self._start, self.schedule.at
        return aim if at < now else len(self.fit) if now >= self._until else max(len(self.fit), aim)

    def _has_converged(self) -> bool:
        """Returns whether further passes over all views hardly reduce the loss."""
        losses, window = self.fit.losses, STOP_ROUNDS * len(self.views)
        if self.settings.stop_gain == 0 or len(losses) % window or len(losses) < 2 * window:
            return False
        before, now = np.mean(losses[-2 * window : -window]), np.mean(losses[-window:])
        return bool(before - now < self.settings.stop_gain * before)

    def scalars(self, now: FitStep) -> FitScalars:
        """Returns the learning rates for an iteration.

        The last iterations also measure the colour shift of each camera.
        """
        # A shortened fit may end in the middle of a pass, but two passes include every view.
        rounds = 1 if self.schedule.stride == 1 else 2 * self.schedule.stride
        ending = now.begun >= self._last - len(self.views) * rounds
        return FitScalars(self._rates(now.begun), 1 - 0.9 * now.begun / self.settings.iterations, ending)

    def _rates(self, at: float) -> Array:
        share = at / max(self.settings.iterations - 1, 1)
        position = RATE_POSITION ** (1 - share) * RATE_POSITION_END**share
        rates = np.empty(COLUMNS, np.float32)
        rates[MEAN] = position * self.radius
        rates[QUATERNION] = RATE_ROTATION
        rates[SCALE] = RATE_SCALE
        rates[OPACITY] = RATE_OPACITY
        rates[COLOUR] = RATE_COLOUR
        rates[LABEL] = RATE_OPACITY if self._masked else 0.0
        return rates

    def control_density(self, target: int) -> None:
        """Removes nearly transparent Gaussians, and densifies Gaussians with large gradients.

        Gaussians with the largest screen-space gradients come first. Of these, larger Gaussians are
        split and smaller Gaussians are cloned. In a deep scene, all Gaussians also shrink.

        Args:
            target: target number of Gaussians.
        """
        if not self._deep:
            cameras = [view.camera for view in self.views]
            self._deep = pair_counts(self.fit.renderer, self.gaussians(), cameras).mean > DEEP
        parameters, statistics = self.fit.table.parameters, self.fit.table.statistics
        assert statistics is not None
        if self._deep:
            # A shortened fit has fewer iterations between two steps, in which the scales could grow again.
            parameters[:, SCALE] += np.float32(np.log(DEEP_SHRINK) / self.schedule.stride)
        opacity = 1 / (1 + np.exp(-parameters[:, OPACITY.start]))
        score = statistics.screen_gradients / np.maximum(statistics.rendered, 1)
        keep = opacity >= min(PRUNE_OPACITY, float(np.median(opacity)))  # never more than half at once
        room = max(0, min(target, self.budget) - int(keep.sum()))
        score = np.where(keep & (score >= DENSIFY_GRADIENT), score, 0)
        chosen = np.argsort(-score, kind="stable")[: min(room, int((score > 0).sum()))]
        largest = parameters[:, SCALE].max(axis=1)
        median = np.median(largest[keep])
        split = chosen[largest[chosen] > median]
        clone = chosen[largest[chosen] <= median]
        halves = [self._half(parameters[split], statistics.factors[split]) for _ in range(2)]
        keep[split] = False
        added, parents = np.concatenate([parameters[clone], *halves]), np.concatenate([clone, split, split])
        self.fit.replace_rows(np.flatnonzero(keep), added, parents)

    def remove_unseen(self) -> None:
        """Removes Gaussians that fewer than ``MIN_VIEWS`` cameras see.

        A Gaussian that no camera sees is unconstrained and may become visible when the scene moves.
        A Gaussian that only one camera sees is a floater, which fits the image of this camera but
        degrades all other views. Outside the stage, one camera suffices.
        """
        counts = np.zeros(len(self.fit), np.int64)
        state = self.gaussians()
        for view in self.views:
            everywhere = np.ones((1, view.camera.height, view.camera.width), np.float32)
            counts += self.fit.renderer.gather(state, view.camera, everywhere)[:, 0] > SEEN_PIXELS
        needed = np.full(len(counts), min(MIN_VIEWS, len(self.views)))
        if self.stage is not None:  # the surroundings occlude nothing in other views
            needed[~self.stage.holds(state.means)] = 1
        keep = counts >= needed
        if keep.any():
            none = np.zeros(0, np.int64)
            self.fit.replace_rows(np.flatnonzero(keep), np.zeros((0, COLUMNS), np.float32), none)

    def _half(self, half: Array, factors: Array) -> Array:
        """Returns copies of Gaussians with smaller scales, and means sampled from the originals.

        Args:
            half: [K, 15] parameter rows of the Gaussians.
            factors: [K, 3, 3] covariance factors of the Gaussians.
        """
        offset = self.random.standard_normal((len(half), 3)).astype(np.float32)
        half = half.copy()
        half[:, MEAN] += np.einsum("nij,nj->ni", factors, offset)
        half[:, SCALE] -= np.log(SPLIT_SHRINK)
        return half

    def gaussians(self) -> Gaussians:
        """Returns the state Θ_0. Without masks, all Gaussians are labelled as foreground."""
        state = self.fit.state()
        return state if self._masked else state.replace(foreground=np.ones(len(state), np.float32))

    def result(self, losses: list[float]) -> StaticResult:
        """Returns the result after the iterations so far."""
        exposures, planned, shortened = self.exposures.by_camera(), self.schedule.record, self.schedule.shortened
        return StaticResult(
            self.gaussians(),
            exposures,
            losses,
            self.fit.psnr,
            self.cameras,
            planned=planned,
            ran_short_of_time=shortened,
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
    device: Device = "cpu",
) -> StaticTrainer:
    """Creates a trainer whose initial Gaussians are the points of a cloud.

    Args:
        factory: factory that creates the scene's views.
        views: views of frame 0. Their exposures are learnt in place.
        positions: [P, 3] point positions in metres, in the internal world.
        colours: [P, 3] point colours in [0, 1].
        foreground: [P] foreground label of each point in [0, 1], or None.
        scene: settings of the scene.
        settings: fit settings for frame 0.
        limit: time limit of frame 0, or None for no limit.
        stage: region that contains the scene, in the internal world. Outside of this region, only
            one camera must see a Gaussian. None if there are no surroundings.
        device: device that runs the fit.

    Raises:
        ValueError: if the point cloud is empty.
    """
    if len(positions) == 0:
        raise ValueError("the initial point cloud is empty; provide points, masks, or more overlapping cameras")
    rng = np.random.default_rng(settings.seed)
    most = max(1, int(INITIAL_SHARE * budget(views, scene, settings)))
    parameters = initial_parameters(positions, colours, foreground, most, rng)
    return StaticTrainer(factory, views, parameters, scene, settings, limit, stage, device)
