"""One frame: from Θ_{t−1} and the pictures of frame t to Θ_t (paper, algorithm 1). The loop is ``FrameUpdate.run``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import cos, pi
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from scas4d_core.deformation_cpu import CpuDeformation
from scas4d_core.gaussians import Gaussians
from scas4d_core.hierarchy import Hierarchy
from scas4d_core.kernels.adam import adam
from scas4d_core.neighbours import Neighbours
from scas4d_core.picture_loss import PictureLoss
from scas4d_core.settings import SceneSettings, UpdateSettings
from scas4d_core.views import TrainingView, ViewFactory, view_order
from scas4d_core.warm_start import Motion, quaternion_products, warm_start

Array = NDArray[np.float32]

STANDARD_RADIUS_M = 4.0
"""The scene radius for which the translation rates of the layers are given."""


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
    """Adam over one table of parameters, with a rate per column."""

    def __init__(self, parameters: Array, rates: list[float], settings: UpdateSettings) -> None:
        self._parameters = parameters
        self._first, self._second = np.zeros_like(parameters), np.zeros_like(parameters)
        self._rates = np.array(rates, np.float32)
        self._beta1, self._beta2 = np.float32(settings.beta1), np.float32(settings.beta2)

    def step(self, gradients: Array, number: int, factor: float) -> None:
        """Step ``number`` (from 1), all rates times ``factor``."""
        rates = self._rates * np.float32(factor)
        adam(self._parameters, gradients, self._first, self._second, rates, self._beta1, self._beta2, number)


@dataclass(frozen=True, eq=False)
class Updated:
    """What an update leaves: Θ_t, the motion that warms the next start, and how it went.

    ``losses`` holds each iteration's weighted sum, ``psnr`` the dB of the view it rendered.
    """

    gaussians: Gaussians
    motion: Motion
    losses: list[float]
    psnr: list[float]
    seconds: dict[str, float]


class FrameUpdate:
    """Updates the frames of one scene for one hierarchy; buffers are kept from frame to frame."""

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
        self._radius = factory.rig.radius
        weights = settings.weights
        self._picture = PictureLoss(factory, scene.background, weights.image, weights.mask)
        lengths = np.sqrt(np.square(first.factors[hierarchy.rows]).sum(axis=1))
        bounds = np.maximum(lengths, np.float32(settings.max_scale))
        self._deformation = CpuDeformation(hierarchy, neighbours, bounds, settings.cluster_map)

    def run(
        self, previous: Gaussians, views: list[TrainingView], motion: Motion | None, seconds: float, seed: int
    ) -> Updated:
        """Find D_t and apply it.

        Args:
            previous: Θ_{t−1}. views: of frame t. motion: what the previous update left, or None.
            seconds: between the frames. seed: of the order of views and the sampled neighbourhoods.
        """
        settings, deformation = self.settings, self._deformation
        rng = np.random.default_rng([settings.seed, seed])
        watch = Stopwatch()
        pictures = self._pictures(views, view_order(len(views), settings.iterations, rng))
        samples = self._samples(rng)
        deformation.start(previous)
        warm_start(deformation, motion, seconds, settings)
        features = np.concatenate([previous.colours, previous.foreground[:, None]], axis=1)
        colours = features[:, :3].copy()
        optimizers = self._optimizers(colours)
        losses, psnr = [], []
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
            loss += self._neighbour_terms(samples[iteration % len(samples)], gradients.means)
            watch.lap("neighbours")
            weight = settings.weights.scale
            loss += weight * deformation.backward(gradients.means, gradients.factors, weight)
            watch.lap("cascade backward")
            g_colours = gradients.features[:, :3] + self._soft_colour(colours, previous.colours)
            tables = [*deformation.cluster_gradients, deformation.delta_gradients, g_colours]
            factor = self._rate_factor(iteration)
            for optimizer, table in zip(optimizers, tables, strict=True):
                optimizer.step(table, iteration + 1, factor)
            losses.append(loss)
            watch.lap("adam")
        deformation.forward()
        updated = Updated(self._commit(previous, colours), Motion.of(deformation, seconds), losses, psnr, {})
        watch.lap("commit")
        updated.seconds.update(watch.seconds)
        return updated

    def _pictures(self, views: list[TrainingView], order: Sequence[int]) -> list[TrainingView]:
        """The picture of each iteration: coarser ones first, where the settings say so."""
        settings = self.settings
        coarse = order[: round(settings.coarse_until * settings.iterations)]
        small = {index: self._factory.coarser(views[index], settings.coarse_scale) for index in set(coarse)}
        return [small[index] for index in coarse] + [views[index] for index in order[len(coarse) :]]

    def _optimizers(self, colours: Array) -> list[Adam]:
        """One per table: each layer of clusters, the Gaussians' own deltas, the colours. Moments start at zero."""
        settings = self.settings
        optimizers = []
        for k, values in enumerate(self._deformation.clusters):
            rates = settings.layer_rates[min(k, len(settings.layer_rates) - 1)]
            translation = rates.translation * self._radius / STANDARD_RADIUS_M
            columns = [rates.rotation] * 3 + [translation] * 3 + [rates.scaling] * 4
            optimizers.append(Adam(values, columns, settings))
        position = settings.rate_position * self._radius
        columns = [position] * 3 + [settings.rate_rotation] * 3 + [settings.rate_scale] * 3
        optimizers.append(Adam(self._deformation.deltas, columns, settings))
        optimizers.append(Adam(colours, [settings.rate_colour] * 3, settings))
        return optimizers

    def _samples(self, rng: np.random.Generator) -> list[NDArray[np.int64]]:
        """Disjoint random sets of moving Gaussians that together cover all: each iteration looks at one."""
        count = len(self.hierarchy.rows)
        order = rng.permutation(count)
        size = min(self.settings.neighbour_sample, max(count, 1))
        return [np.sort(order[k : k + size]) for k in range(0, max(count, 1), size)]

    def _neighbour_terms(self, sample: NDArray[np.int64], g_means: Array) -> float:
        weights = self.settings.weights
        strengths = (weights.rigidity, weights.isometry, weights.rotation)
        parts = self._deformation.neighbour_losses(sample, strengths, g_means)
        return float(np.dot(strengths, parts))

    def _soft_colour(self, colours: Array, previous: Array) -> Array:
        """Gradient of the soft-colour loss: mean absolute change of colour."""
        weight = np.float32(self.settings.weights.soft_colour / max(colours.size, 1))
        gradient: Array = weight * np.sign(colours - previous)
        return gradient

    def _rate_factor(self, iteration: int) -> float:
        """Half a cosine from 1 at the first iteration to ``rate_end`` at the last."""
        end, last = self.settings.rate_end, max(self.settings.iterations - 1, 1)
        return end + (1 - end) * 0.5 * (1 + cos(pi * iteration / last))

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
