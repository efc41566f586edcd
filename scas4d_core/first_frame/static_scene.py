"""Frame 0: 3D Gaussian Splatting with adaptive density control (Kerbl et al. 2023), under a budget of Gaussians."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scas4d_core.gaussians import Gaussians
from scas4d_core.kernels import activation
from scas4d_core.kernels.adam import EVERY_ROW, adam
from scas4d_core.rasterize.limits import scene_limits
from scas4d_core.settings import SceneSettings, StaticSettings
from scas4d_core.update.picture_loss import PictureLoss
from scas4d_core.update.result import CameraFit, camera_fit
from scas4d_core.update.views import TrainingView, ViewFactory, view_order

Array = NDArray[np.float32]

BETA1, BETA2 = np.float32(0.9), np.float32(0.999)
MEAN, QUATERNION, SCALE, OPACITY, COLOUR, LABEL = (
    slice(0, 3), slice(3, 7), slice(7, 10), slice(10, 11), slice(11, 14), slice(14, 15)
)  # fmt: skip

INITIAL_OPACITY = 0.1
EXPOSURE_TRIAL, EXPOSURE_SPREAD = 0.3, 0.015
"""Share of the iterations after which exposure terms are judged, and the standard deviation of the gains over cameras
below which they go. After 900 iterations it was 0.004 and 0.007 where there is no difference, 0.033 on a real rig."""
SPLIT_SHRINK = 1.6
"""A split Gaussian's halves are smaller by this (3DGS)."""


@dataclass(frozen=True, eq=False)
class StaticResult:
    """What frame 0 leaves.

    Attributes:
        gaussians: Θ_0. exposures: [3, 2] gain and offset of each training camera, empty without exposure terms.
        losses: the training loss of every iteration. psnr: dB of the view that each iteration rendered.
        cameras: by name, how well each camera's picture was met when it was last rendered.
    """

    gaussians: Gaussians
    exposures: dict[str, Array]
    losses: list[float]
    psnr: list[float] = field(default_factory=list)
    cameras: dict[str, CameraFit] = field(default_factory=dict)


def logit(probability: NDArray[np.floating]) -> NDArray[np.floating]:
    """Inverse of the sigmoid, away from its ends."""
    clipped = np.clip(probability, 1e-4, 1 - 1e-4)
    result: NDArray[np.floating] = np.log(clipped / (1 - clipped))
    return result


def initial_parameters(
    positions: NDArray[np.float64], colours: Array, foreground: Array | None, limit: int, rng: np.random.Generator
) -> Array:
    """A row of parameters per point: round Gaussians as wide as the mean distance to their three nearest neighbours.

    Args:
        positions: [P, 3] metres inside. colours: [P, 3] in 0…1. foreground: [P] label or None.
        limit: points beyond this many are left out at random.
    """
    if len(positions) > limit:
        keep = np.sort(rng.choice(len(positions), limit, replace=False))
        positions, colours = positions[keep], colours[keep]
        foreground = None if foreground is None else foreground[keep]
    neighbours = min(4, len(positions))
    distances = cKDTree(positions).query(positions, k=neighbours)[0]
    squared = np.square(distances).reshape(len(positions), -1)[:, 1:]
    width = np.sqrt(np.maximum(squared.mean(axis=1), 1e-7)) if neighbours > 1 else np.full(len(positions), 0.05)
    parameters = np.zeros((len(positions), activation.COLUMNS), np.float32)
    parameters[:, MEAN] = positions
    parameters[:, 3] = 1
    parameters[:, SCALE] = np.log(width)[:, None]
    parameters[:, OPACITY] = logit(np.array(INITIAL_OPACITY))
    parameters[:, COLOUR] = colours
    parameters[:, LABEL] = 0 if foreground is None else logit(np.clip(foreground, 0.1, 0.9))[:, None]
    return parameters


PER_PIXEL, PER_COVERED_PIXEL, LARGEST_BUDGET = 0.34, 0.27, 100_000
"""The rule for the budget of Gaussians, see ``StaticSettings.max_gaussians``. Detail lies on objects: a picture that is
mostly background asks for nearly as many Gaussians as a full one. Beyond the largest an update takes seconds."""

STOP_ROUNDS = 5
"""Rounds over all views that the stop rule compares with as many before: in fewer the order of views is noise."""

PLAIN = 2 / 255
"""A pixel this near the background's colour is background."""


def budget(views: list[TrainingView], scene: SceneSettings, settings: StaticSettings) -> int:
    """How many Gaussians the scene may have."""
    if settings.max_gaussians is not None:
        return settings.max_gaussians
    background = np.array(scene.background, np.float32)[:, None, None]
    pixels = float(np.mean([view.camera.width * view.camera.height for view in views]))
    covered = float(np.mean([(np.abs(view.target[:3] - background).max(axis=0) > PLAIN).mean() for view in views]))
    return min(LARGEST_BUDGET, max(1, int(pixels * (PER_PIXEL + PER_COVERED_PIXEL * covered))))


class StaticTrainer:
    """Fits Gaussians to the views of one frame."""

    def __init__(
        self,
        factory: ViewFactory,
        views: list[TrainingView],
        parameters: Array,
        scene: SceneSettings,
        settings: StaticSettings,
    ) -> None:
        self.settings = settings
        self.views = views
        self.parameters = parameters
        self.budget = budget(views, scene, settings)
        self.radius = factory.rig.radius
        limits = scene_limits(scene.near, self.radius)
        self._loss = PictureLoss(factory, scene.background, 1.0, settings.weight_mask, False, limits)
        self._masked = any(len(view.target) > 3 for view in views)
        self._rng = np.random.default_rng(settings.seed)
        self._reset_moments()
        self.exposing = settings.exposure is not False
        self.psnr: list[float] = []
        self._last = settings.iterations
        self.cameras: dict[str, CameraFit] = {}
        self._exposure_moments = {view.name: np.zeros((2, *view.exposure.shape), np.float32) for view in views}

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

    def train(self, progress: Callable[[int, float], None] | None = None) -> list[float]:
        """Run all iterations, or as many as the stop rule lets; ``progress`` gets the iteration and the loss."""
        settings = self.settings
        losses: list[float] = []
        order = view_order(len(self.views), settings.iterations, self._rng)
        self._allocate()
        start = len(self.parameters)
        until = int(settings.densify_until * settings.iterations)
        for iteration, index in enumerate(order):
            losses.append(self.step(self.views[index], iteration))
            done = iteration + 1
            if settings.densify_from <= done <= until and done % settings.densify_every == 0:
                share = (done - settings.densify_from) / max(until - settings.densify_from, 1)
                self.control_density(round(start + (self.budget - start) * min(1.0, share + 0.1)))
            if done == until or done == (until + settings.iterations) // 2:
                self.remove_unseen()
            if done > until and self._last == settings.iterations and self._settled(losses):
                self._last = min(settings.iterations, done + len(self.views))
                self.remove_unseen()
            if settings.exposure == "auto" and done == round(EXPOSURE_TRIAL * settings.iterations):
                self._judge_exposure()
            if progress is not None:
                progress(done, losses[-1])
            if done == self._last:
                break
        return losses

    def _settled(self, losses: list[float]) -> bool:
        """The stop rule: rounds over all views no longer lower the loss. One more round of them follows the verdict."""
        window = STOP_ROUNDS * len(self.views)
        if self.settings.stop_gain == 0 or len(losses) % window or len(losses) < 2 * window:
            return False
        before, now = np.mean(losses[-2 * window : -window]), np.mean(losses[-window:])
        return bool(before - now < self.settings.stop_gain * before)

    def step(self, view: TrainingView, iteration: int) -> float:
        """One iteration: render the view, compare, carry back, Adam. Returns the loss."""
        activation.activate(self.parameters, self._means, self._factors, self._opacities, self._features)
        gradients = self._loss.evaluate(self._means, self._factors, self._opacities, self._features, view)
        self.psnr.append(self._loss.psnr)
        if iteration >= self._last - len(self.views):
            self.cameras[view.name] = camera_fit(self._loss.psnr, self._loss.colour_shift(view))
        activation.activate_backward(
            self.parameters, self._factors, self._opacities, self._features, gradients.means, gradients.factors,
            gradients.opacities, gradients.features, self._gradients,
        )  # fmt: skip
        width = np.array([view.camera.width / 2, view.camera.height / 2], np.float32)
        visible = self._loss.rasterizer.counts > 0
        self._screen += np.sqrt(np.square(gradients.screen * width).sum(axis=1))
        self._seen += visible
        adam(
            self.parameters, self._gradients, self._first, self._second, self._rates(iteration), EVERY_ROW, BETA1,
            BETA2, iteration + 1,
        )  # fmt: skip
        if self.exposing:
            self._step_exposure(view, iteration)
        return self._loss.image_part + self._loss.mask_part

    def _rates(self, iteration: int) -> Array:
        settings = self.settings
        share = iteration / max(settings.iterations - 1, 1)
        position = settings.rate_position ** (1 - share) * settings.rate_position_end**share
        rates = np.empty(activation.COLUMNS, np.float32)
        rates[MEAN] = position * self.radius
        rates[QUATERNION] = settings.rate_rotation
        rates[SCALE] = settings.rate_scale
        rates[OPACITY] = settings.rate_opacity
        rates[COLOUR] = settings.rate_colour
        rates[LABEL] = settings.rate_opacity if self._masked else 0.0
        return rates

    def _step_exposure(self, view: TrainingView, iteration: int) -> None:
        """Adam on the camera's gain and offset; afterwards their mean over cameras is brought back to 1 and 0."""
        moments = self._exposure_moments[view.name]
        rates = np.full(2, self.settings.rate_exposure, np.float32)
        gradient = self._loss.exposure_gradient[: len(view.exposure)].copy()
        gradient[3:] = 0
        adam(view.exposure, gradient, moments[0], moments[1], rates, EVERY_ROW, BETA1, BETA2, iteration + 1)
        centre = np.mean([other.exposure[:3] for other in self.views], axis=0) - np.array([1, 0], np.float32)
        for other in self.views:
            other.exposure[:3] -= centre

    def _judge_exposure(self) -> None:
        """Give up the gains and offsets where they hardly differ from camera to camera."""
        gains = np.array([view.exposure[:3, 0] for view in self.views])
        if gains.std(axis=0).mean() < EXPOSURE_SPREAD:
            self.exposing = False
            for view in self.views:
                view.exposure[:] = (1, 0)

    def control_density(self, target: int) -> None:
        """Remove what is all but transparent; clone or split those the pictures pull hardest, up to ``target``."""
        settings = self.settings
        opacity = 1 / (1 + np.exp(-self.parameters[:, 10]))
        score = self._screen / np.maximum(self._seen, 1)
        keep = opacity >= min(settings.prune_opacity, float(np.median(opacity)))  # never more than half at once
        room = max(0, min(target, self.budget) - int(keep.sum()))
        score = np.where(keep & (score >= settings.densify_gradient), score, 0)
        chosen = np.argsort(-score, kind="stable")[: min(room, int((score > 0).sum()))]
        largest = self.parameters[:, SCALE].max(axis=1)
        median = np.median(largest[keep])
        split = chosen[largest[chosen] > median]
        clone = chosen[largest[chosen] <= median]
        halves = [self._half(split), self._half(split)]
        keep[split] = False
        self._take(np.flatnonzero(keep), [self.parameters[clone], *halves])

    def remove_unseen(self) -> None:
        """Remove what fewer than ``min_views`` cameras see.

        What no camera sees is free to be anything and shows once the scene moves; what one alone sees is a floater
        that explains that camera's picture and spoils every other.
        """
        activation.activate(self.parameters, self._means, self._factors, self._opacities, self._features)
        counts = np.zeros(len(self.parameters), np.int64)
        for view in self.views:
            seen = self._loss.coverage(self._means, self._factors, self._opacities, self._features, view)
            counts += seen > self.settings.seen_pixels
        keep = counts >= min(self.settings.min_views, len(self.views))
        if keep.any():
            self._take(np.flatnonzero(keep), [])

    def _take(self, rows: NDArray[np.int64], added: list[Array]) -> None:
        """Keep some rows with their moments and append others with none."""
        fresh = np.zeros((sum(map(len, added)), activation.COLUMNS), np.float32)
        first = np.concatenate([self._first[rows], fresh])
        second = np.concatenate([self._second[rows], fresh])
        self.parameters = np.ascontiguousarray(np.concatenate([self.parameters[rows], *added]))
        self._reset_moments()
        self._first, self._second = first, second
        self._allocate()

    def _half(self, rows: NDArray[np.int64]) -> Array:
        """The rows, smaller, and displaced by a sample of themselves."""
        half = self.parameters[rows].copy()
        offset = self._rng.standard_normal((len(rows), 3)).astype(np.float32)
        half[:, MEAN] += np.einsum("nij,nj->ni", self._factors[rows], offset)
        half[:, SCALE] -= np.log(SPLIT_SHRINK)
        return half

    def gaussians(self) -> Gaussians:
        """Θ_0. Without masks everything may move."""
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
        )


def fit_static_scene(
    factory: ViewFactory,
    views: list[TrainingView],
    positions: NDArray[np.float64],
    colours: Array,
    foreground: Array | None,
    scene: SceneSettings,
    settings: StaticSettings,
    progress: Callable[[int, float], None] | None = None,
) -> StaticResult:
    """Θ_0 from the views of frame 0 and a first cloud.

    Args:
        positions: [P, 3] metres inside. colours: [P, 3] in 0…1. foreground: [P] or None.

    Raises:
        ValueError: the cloud is empty.
    """
    if len(positions) == 0:
        raise ValueError("the first cloud holds no point; give points, masks, or more overlapping cameras")
    rng = np.random.default_rng(settings.seed)
    limit = max(1, int(settings.initial_share * budget(views, scene, settings)))
    parameters = initial_parameters(positions, colours, foreground, limit, rng)
    trainer = StaticTrainer(factory, views, parameters, scene, settings)
    losses = trainer.train(progress)
    exposures = {view.name: view.exposure[:3].copy() for view in views} if trainer.exposing else {}
    return StaticResult(trainer.gaussians(), exposures, losses, trainer.psnr, trainer.cameras)
