"""Update of one frame on the CPU: from Θ_{t−1} and the pictures of frame t to Θ_t (paper, algorithm 1).

The loop is ``FrameUpdate.run``: deform, render and compare, tie neighbours, carry back, step.
"""

from __future__ import annotations

from typing import Protocol
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import WorldFrame
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians
from scas4d_core.guards import summed
from scas4d_core.rasterize.cpu import Gradients
from scas4d_core.rasterize.limits import scene_limits
from scas4d_core.settings import SceneSettings, Settings, UpdateSettings
from scas4d_core.structure.hierarchy import Hierarchy, build_hierarchy
from scas4d_core.structure.neighbours import Neighbours, build_neighbours
from scas4d_core.update import schedule
from scas4d_core.update.best_state import BestState, ProbeViews
from scas4d_core.update.deformation import CpuDeformation, length_bounds
from scas4d_core.update.floor import floor_inside, floor_term
from scas4d_core.update.picture_loss import PictureLoss, TrainingView, ViewFactory
from scas4d_core.update.result import AS_SET, REPORT, AttemptOptions, Stopwatch, UpdateResult, UpdateTrace
from scas4d_core.update.schedule import Adam, Rates, Stopping, ViewPlan, mask_weight, plan_samples
from scas4d_core.update.warm_start import Motion, quaternion_products

Array = NDArray[np.float32]

SMALLEST_CLUSTER = 8
"""Gaussians of a cluster, on average, that the layers are capped to: the motion of fewer is noise."""
NEIGHBOURS = 20
"""Neighbours of a Gaussian in the terms that tie it to them (Dynamic3DGaussians)."""
NEIGHBOUR_FALLOFF = 2000.0
"""1/m²: the weight of a neighbour at a distance d is exp(−falloff d²) (Dynamic3DGaussians)."""


class Updater(Protocol):
    """Updates the frames of one scene for one hierarchy, on some device."""

    hierarchy: Hierarchy

    def run(
        self,
        previous: Gaussians,
        views: list[TrainingView],
        motion: Motion | None,
        seconds: float,
        seed: int,
        options: AttemptOptions = AS_SET,
    ) -> UpdateResult:
        """Find D_t and apply it.

        Args:
            previous: Θ_{t−1}. views: of frame t. motion: that the previous update found, or None.
            seconds: between the frames. seed: of the order of views and the sampled neighbourhoods.
            options: of this attempt.
        """


class FrameUpdate:
    """The ``Updater`` of the CPU; buffers are kept from frame to frame.

    Attributes:
        tells: whether figures that the report alone needs are worked out; the state is the same without.
    """

    tells = True

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
        self._picture = PictureLoss(factory, scene.background, schedule.IMAGE_WEIGHT, mask, limits=limits)
        bounds = length_bounds(hierarchy, first)
        self._deformation = CpuDeformation(hierarchy, neighbours, bounds, settings.cluster_map, settings.covariance)

    def run(
        self,
        previous: Gaussians,
        views: list[TrainingView],
        motion: Motion | None,
        seconds: float,
        seed: int,
        options: AttemptOptions = AS_SET,
    ) -> UpdateResult:
        """Find D_t and apply it, see ``Updater.run``."""
        settings, deformation = self.settings, self._deformation
        stopping = options.stopping or Stopping(settings.iterations)
        rng = np.random.default_rng([settings.seed, seed])
        watch, trace = Stopwatch(), UpdateTrace()
        plan = ViewPlan(views, settings.views, stopping.most, rng)
        samples = plan_samples(len(self.hierarchy.rows), rng)
        features = np.concatenate([previous.colours, previous.foreground[:, None]], axis=1)
        colours = previous.colours.copy()
        counts = (deformation.guards, self._picture.rasterizer.guards)
        for guards in counts:
            guards.reset()
        deformation.start(previous)
        probes = ProbeViews(self._factory, self._picture, views if options.compare else [])
        best = BestState(probes, deformation, previous, motion, seconds, settings.momentum)
        best.start(options.step)
        optimizers = self._optimizers(colours, options, cold=motion is None)
        weights = settings.weights
        soft = np.float32(schedule.SOFT_COLOUR_WEIGHT / max(colours.size, 1))  # of the mean absolute change of colour
        if best.stands(options.enough):
            stopping = Stopping(0)
        watch.lap("start")
        while (iteration := trace.iterations) < (planned := stopping.planned(iteration)):
            deformation.forward()
            features[:, :3] = colours
            watch.lap("cascade")
            met = len(trace.first)
            loss, gradients = self._pictures(plan.take(), previous.opacities, features, trace, watch)
            loss += self._neighbour_terms(samples[iteration % len(samples)])
            if self._floor is not None:
                loss += floor_term(self._floor, deformation.means, self.hierarchy.rows, weights.floor, gradients.means)
            watch.lap("neighbours")
            loss += weights.scale * deformation.backward(gradients.means, gradients.factors, weights.scale)
            watch.lap("cascade backward")
            change = colours - previous.colours
            self._step(optimizers, gradients.features[:, :3] + soft * np.sign(change), iteration, planned)
            watch.lap("adam")
            if self.tells:
                loss += float(soft * np.abs(change).sum(dtype=np.float64))
            trace.losses.append(loss)
            trace.moments.append(watch.total)
            watch.lap(REPORT)
            if options.gate is not None and met < len(trace.first) == len(views):  # each camera was rendered once
                trace.left_out.update(options.gate(trace.first))
                plan.leave_out(trace.left_out)
                watch.lap("judge")
            if stopping.looks(trace.iterations):
                stopping.saw(trace.iterations, best.error(colours))
                watch.lap("looks")
        deformation.forward()
        trace.planned, trace.errors = stopping.planned_so_far, best.errors
        trace.kept = kept = best.end(colours, trace.iterations, trace.left_out)
        watch.lap("end")
        state = previous
        if kept is not Candidate.STILL:
            state = self._commit(previous, colours if kept is Candidate.END else previous.colours)
        found = Motion.of(deformation, best.seconds)
        acted = summed([*counts, *(optimizer.guards for optimizer in optimizers)])
        trace.guards = {name: count for name, count in acted.items() if count}
        watch.lap("commit")
        trace.seconds = watch.seconds
        return UpdateResult(state, found, trace)

    def _optimizers(self, colours: Array, options: AttemptOptions, cold: bool) -> list[Adam]:
        """One per table: each layer of clusters, the Gaussians' own deltas, the colours. Moments start at zero."""
        rates = self._rates.tried(options.rates, options.rigid, options.hold_colours)
        rates, deformation = rates.hurried(self.settings.cold_start if cold else 1.0), self._deformation
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

    def _step(self, optimizers: list[Adam], g_colours: Array, iteration: int, planned: int) -> None:
        """Adam's step of every table, in the order of ``_optimizers``."""
        tables = [*self._deformation.cluster_gradients, self._deformation.delta_gradients, g_colours]
        for optimizer, table in zip(optimizers, tables, strict=True):
            optimizer.step(table, iteration, planned)

    def _pictures(
        self, views: list[TrainingView], opacities: Array, features: Array, trace: UpdateTrace, watch: Stopwatch
    ) -> tuple[float, Gradients]:
        """Image and mask loss, the mean over the views, and its gradients; a single view's are the rasterizer's own."""
        deformation, picture = self._deformation, self._picture
        loss, total = 0.0, None
        for view in views:
            found = picture.evaluate(deformation.means, deformation.factors, opacities, features, view, watch.lap)
            loss += picture.image_part + picture.mask_part
            trace.see(view, picture, self.tells)
            watch.lap(REPORT)
            if len(views) == 1:
                return loss, found
            if total is None:
                total = Gradients(*(array.copy() for array in found))
            else:
                for array, more in zip(total, found, strict=True):
                    array += more
        assert total is not None  # an iteration has a view
        for array in total:
            array /= len(views)
        watch.lap("render backward")
        return loss / len(views), total

    def _neighbour_terms(self, sample: NDArray[np.int64]) -> float:
        weights = self.settings.weights
        strengths = (weights.rigidity, weights.isometry, weights.rotation)
        parts = self._deformation.neighbour_losses(sample, strengths)
        return float(np.dot(strengths, parts))

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


def prepare(first: Gaussians, factory: ViewFactory, settings: Settings, world: WorldFrame) -> tuple[Updater, int]:
    """The updater of ``settings.device``, with the hierarchy and the neighbour graph of the moving Gaussians.

    Args:
        first: Θ_0, with the labels to go by. factory: of the scene's views. world: user's to inside.

    Returns:
        The updater, and the digest of its clusters and neighbours.
    """
    update = settings.update
    hierarchy = build_hierarchy(first.means, first.moving, update.clusters, SMALLEST_CLUSTER, update.seed)
    weights = update.weights
    tied = weights.rigidity + weights.isometry + weights.rotation > 0
    neighbours = build_neighbours(first.means[hierarchy.rows], NEIGHBOURS, NEIGHBOUR_FALLOFF) if tied else None
    structure = digest(hierarchy, neighbours)
    scene = settings.scene
    if scene.floor is not None:
        scene = scene.model_copy(update={"floor": floor_inside(scene.floor, world)})
    given = (factory, scene, update, hierarchy, neighbours, first)
    if settings.device == "cpu":
        return FrameUpdate(*given), structure
    from scas4d_core.torch_backend.device_update import DeviceUpdate  # torch is loaded only where it is used

    return DeviceUpdate(*given, device=settings.device), structure


def digest(hierarchy: Hierarchy, neighbours: Neighbours | None) -> int:
    """CRC-32 of the clusters and the neighbour graph."""
    arrays = [hierarchy.rows, *hierarchy.labels, *hierarchy.starts]
    if neighbours is not None:
        arrays += [neighbours.index, neighbours.weights, neighbours.distances]
    value = 0
    for array in arrays:
        value = crc32(np.ascontiguousarray(array).view(np.uint8).data, value)
    return value
