"""One frame: from Θ_{t−1} and the pictures of frame t to Θ_t (paper, algorithm 1). The loop is ``FrameUpdate.run``."""

from __future__ import annotations

from dataclasses import dataclass, field
from time import perf_counter
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from scas4d_core.deformation_cpu import CpuDeformation
from scas4d_core.floor import floor_term
from scas4d_core.gaussians import Gaussians
from scas4d_core.hierarchy import Hierarchy
from scas4d_core.kernels.adam import EVERY_ROW, adam
from scas4d_core.neighbours import Neighbours
from scas4d_core.picture_loss import PictureLoss
from scas4d_core.rasterize.limits import scene_limits
from scas4d_core.settings import SceneSettings, UpdateSettings
from scas4d_core.update_plan import Rates, first_lengths, mask_weight, plan_samples, plan_views
from scas4d_core.views import TrainingView, ViewFactory
from scas4d_core.warm_start import Motion, quaternion_products, warm_start

Array = NDArray[np.float32]


@dataclass
class Stopwatch:
    """Seconds by stage."""

    seconds: dict[str, float] = field(default_factory=dict)
    _last: float = field(default_factory=perf_counter)

    def lap(self, stage: str) -> None:
        """Book the time since the last lap to a stage."""
        now = perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now


class Adam:
    """Adam over one table of parameters, with a rate per column, times one per row where given.

    It begins after a share ``start`` of the iterations and leaves the table alone before.
    """

    def __init__(
        self, parameters: Array, columns: list[float], rates: Rates, start: float = 0.0, by_row: Array = EVERY_ROW
    ) -> None:
        self._parameters = parameters
        self._by_row = by_row
        self._first, self._second = np.zeros_like(parameters), np.zeros_like(parameters)
        self._plan, self._start = rates, start
        self._rates = np.array(columns, np.float32)
        self._beta1, self._beta2 = np.float32(rates.beta1), np.float32(rates.beta2)
        self._steps = 0

    def step(self, gradients: Array, iteration: int, iterations: int) -> None:
        """Take the step of an iteration, counted from 0."""
        factor = self._plan.factor(iteration, iterations, self._start)
        if factor == 0:
            return
        self._steps += 1
        adam(
            self._parameters, gradients, self._first, self._second, self._rates * np.float32(factor), self._by_row,
            self._beta1, self._beta2, self._steps,
        )  # fmt: skip


@dataclass(frozen=True)
class CameraFit:
    """How well one camera's picture was met, when it was last rendered.

    Attributes:
        psnr: dB. colour_shift: [3] mean of the picture minus mean of the render, RGB in 0…1; None where not measured.
    """

    psnr: float
    colour_shift: tuple[float, float, float] | None = None


@dataclass(frozen=True, eq=False)
class Updated:
    """What an update leaves: Θ_t, the motion that warms the next start, and how it went.

    ``losses`` holds each iteration's weighted sum, ``psnr`` the dB of the view it rendered; ``cameras`` how well each
    camera was met, by name.
    """

    gaussians: Gaussians
    motion: Motion
    losses: list[float]
    psnr: list[float]
    seconds: dict[str, float]
    cameras: dict[str, CameraFit] = field(default_factory=dict)


class Updater(Protocol):
    """Updates the frames of one scene for one hierarchy, on some device."""

    hierarchy: Hierarchy

    def run(
        self, previous: Gaussians, views: list[TrainingView], motion: Motion | None, seconds: float, seed: int
    ) -> Updated:
        """Find D_t and apply it.

        Args:
            previous: Θ_{t−1}. views: of frame t. motion: what the previous update left, or None.
            seconds: between the frames. seed: of the order of views and the sampled neighbourhoods.
        """


class FrameUpdate:
    """The ``Updater`` of the CPU; buffers are kept from frame to frame."""

    def __init__(
        self,
        factory: ViewFactory,
        scene: SceneSettings,
        settings: UpdateSettings,
        hierarchy: Hierarchy,
        neighbours: Neighbours | None,
        first: Gaussians,
    ) -> None:
        self.settings = settings
        self.hierarchy = hierarchy
        self._factory = factory
        self._rates = Rates.of(settings, len(hierarchy.sizes), factory.rig.radius)
        weights = settings.weights
        self._floor = scene.floor if weights.floor > 0 else None
        mask = mask_weight(settings, len(hierarchy.rows), len(first))
        limits = scene_limits(scene.near, factory.rig.radius)
        self._picture = PictureLoss(factory, scene.background, weights.image, mask, limits=limits)
        bounds = np.maximum(first_lengths(hierarchy, first), np.float32(settings.max_scale))
        self._deformation = CpuDeformation(hierarchy, neighbours, bounds, settings.cluster_map)

    def run(
        self, previous: Gaussians, views: list[TrainingView], motion: Motion | None, seconds: float, seed: int
    ) -> Updated:
        """Find D_t and apply it, see ``Updater.run``."""
        settings, deformation = self.settings, self._deformation
        rng = np.random.default_rng([settings.seed, seed])
        watch = Stopwatch()
        pictures = plan_views(self._factory, views, settings, rng)
        samples = plan_samples(len(self.hierarchy.rows), settings.neighbour_sample, rng)
        deformation.start(previous)
        warm_start(deformation, motion, seconds, settings)
        features = np.concatenate([previous.colours, previous.foreground[:, None]], axis=1)
        colours = previous.colours.copy()
        optimizers = self._optimizers(colours, cold=motion is None)
        losses, psnr = [], []
        cameras: dict[str, CameraFit] = {}
        last = {view.name: iteration for iteration, view in enumerate(pictures)}
        watch.lap("start")
        for iteration, view in enumerate(pictures):
            deformation.forward()
            features[:, :3] = colours
            watch.lap("cascade")
            gradients = self._picture.evaluate(
                deformation.means, deformation.factors, previous.opacities, features, view, watch.lap
            )
            loss = self._picture.image_part + self._picture.mask_part
            psnr.append(self._picture.psnr)
            if last[view.name] == iteration:
                cameras[view.name] = CameraFit(self._picture.psnr, self._picture.colour_shift(view))
            loss += self._neighbour_terms(samples[iteration % len(samples)])
            if self._floor is not None:
                loss += floor_term(
                    self._floor, deformation.means, self.hierarchy.rows, settings.weights.floor, gradients.means
                )
            watch.lap("neighbours")
            weight = settings.weights.scale
            loss += weight * deformation.backward(gradients.means, gradients.factors, weight)
            watch.lap("cascade backward")
            soft, g_soft = self._soft_colour(colours, previous.colours)
            loss += soft
            g_colours = gradients.features[:, :3] + g_soft
            tables = [*deformation.cluster_gradients, deformation.delta_gradients, g_colours]
            for optimizer, table in zip(optimizers, tables, strict=True):
                optimizer.step(table, iteration, settings.iterations)
            losses.append(loss)
            watch.lap("adam")
        deformation.forward()
        updated = Updated(self._commit(previous, colours), Motion.of(deformation, seconds), losses, psnr, {}, cameras)
        watch.lap("commit")
        updated.seconds.update(watch.seconds)
        return updated

    def _optimizers(self, colours: Array, cold: bool) -> list[Adam]:
        """One per table: each layer of clusters, the Gaussians' own deltas, the colours. Moments start at zero."""
        rates, deformation = self._rates.hurried(self.settings.cold_start if cold else 1.0), self._deformation
        columns = [[r] * 3 + [t] * 3 + [scaling] * 4 for r, t, scaling in rates.layers]
        columns.append([rates.position] * 3 + [rates.rotation] * 3 + [rates.scale] * 3)
        starts = [rates.start_of(layer) for layer in range(len(rates.layers))] + [rates.start]
        tables = [*deformation.clusters, deformation.deltas]
        optimizers = [
            Adam(table, given, rates, start) for table, given, start in zip(tables, columns, starts, strict=True)
        ]
        by_row = np.full(len(colours), rates.colour_standing, np.float32)
        by_row[self.hierarchy.rows] = rates.colour
        return [*optimizers, Adam(colours, [1.0] * 3, rates, by_row=by_row)]

    def _neighbour_terms(self, sample: NDArray[np.int64]) -> float:
        weights = self.settings.weights
        strengths = (weights.rigidity, weights.isometry, weights.rotation)
        parts = self._deformation.neighbour_losses(sample, strengths)
        return float(np.dot(strengths, parts))

    def _soft_colour(self, colours: Array, previous: Array) -> tuple[float, Array]:
        """The weighted soft-colour loss, mean absolute change of colour, and its gradient."""
        weight = np.float32(self.settings.weights.soft_colour / max(colours.size, 1))
        change = colours - previous
        gradient: Array = weight * np.sign(change)
        return float(weight * np.abs(change).sum(dtype=np.float64)), gradient

    def _commit(self, previous: Gaussians, colours: Array) -> Gaussians:
        """Θ_t; the material rotation is the turn after all turns before."""
        rows = self.hierarchy.rows
        rotations = previous.rotations.copy()
        turned = quaternion_products(self._deformation.turns, previous.rotations[rows])
        rotations[rows] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
        return previous.replace(
            means=self._deformation.means.copy(),
            factors=self._deformation.factors.copy(),
            rotations=rotations,
            colours=colours,
        )
