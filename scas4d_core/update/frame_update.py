"""Update of one frame on the CPU: from Θ_{t−1} and the pictures of frame t to Θ_t (paper, algorithm 1).

The loop is ``FrameUpdate.run``: deform, render and compare, tie neighbours, carry back, step.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from scas4d_core.effects.parts import NOTHING, Arrays, Hooks, PartsBuilder, Work
from scas4d_core.effects.switches import joined
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians, quaternion_products
from scas4d_core.guards import summed
from scas4d_core.rasterize.cpu import Gradients
from scas4d_core.rasterize.limits import scene_limits
from scas4d_core.settings import SceneSettings, UpdateSettings
from scas4d_core.structure.hierarchy import Hierarchy
from scas4d_core.structure.neighbours import Neighbours
from scas4d_core.update import schedule
from scas4d_core.update.best_state import BestState, ProbeViews
from scas4d_core.update.changed_pixels import MOST, ChangedPixels
from scas4d_core.update.deformation import CpuDeformation, length_bounds
from scas4d_core.update.free_tables import free_tables, freed
from scas4d_core.update.picture_loss import PictureLoss, ViewFactory
from scas4d_core.update.rates import Rates
from scas4d_core.update.result import AS_SET, REPORT, AttemptOptions, Stopwatch, UpdateResult, UpdateTrace
from scas4d_core.update.schedule import Stopping, ViewPlan, plan_samples
from scas4d_core.update.training_view import TrainingView
from scas4d_core.update.warm_start import Motion, predicted

Array = NDArray[np.float32]


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
        carried: Mapping[str, Arrays] = NOTHING,
    ) -> UpdateResult:
        """Find D_t and apply it.

        Args:
            previous: Θ_{t−1}. views: of frame t. motion: that the previous update found, or None.
            seconds: between the frames. seed: of the order of views and the sampled neighbourhoods.
            options: of this attempt. carried: arrays that the effects left, by effect.
        """


class FrameUpdate:
    """The ``Updater`` of the CPU; buffers are kept from frame to frame.

    Attributes:
        tells: whether figures that the report alone needs are worked out; state and evidence are the same without.
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
        parts: PartsBuilder | None = None,
    ) -> None:
        self.settings = settings
        self.hierarchy = hierarchy
        self._factory = factory
        parts = parts or joined(PartsBuilder(scene, settings, factory, hierarchy, first))
        self._hooks, self._length, self._freedom = Hooks(parts.parts), parts.length, parts.freedom
        self._exposes, self._follows = parts.exposes, parts.follows
        self._rates = freed(Rates.of(settings, len(hierarchy.sizes), factory.rig.reach), parts.freedom)
        limits = scene_limits(scene.near, factory.rig.radius)
        given = (factory, scene.behind, schedule.IMAGE_WEIGHT, parts.mask)
        self._picture = PictureLoss(*given, limits=limits)
        if not parts.whole and len(hierarchy.rows) <= MOST * len(first):
            self._picture = ChangedPixels(*given, hierarchy.rows, len(first), limits)
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
        carried: Mapping[str, Arrays] = NOTHING,
    ) -> UpdateResult:
        """Find D_t and apply it, see ``Updater.run``."""
        settings, deformation = self.settings, self._deformation
        motion = predicted(motion, self._freedom)
        if self._exposes:  # another attempt at the frame starts from the exposures that it came with
            views = [replace(view, exposure=view.exposure.copy()) for view in views]
        stopping = options.stopping or Stopping(settings.iterations)
        rng = np.random.default_rng([settings.seed, seed])
        watch, trace = Stopwatch(), UpdateTrace()
        plan = ViewPlan(views, settings.views, stopping.most, rng)
        samples = plan_samples(len(self.hierarchy.rows), rng)
        deformation.guards.reset()
        self._picture.rasterizer.guards.reset()
        deformation.start(previous)
        self._picture.begin(previous)
        probes = ProbeViews(self._factory, self._picture, views if options.compare else [])
        best = BestState(probes, deformation, previous, motion, seconds, settings.momentum)
        best.start(options.step)
        rates = self._rates.tried(options.rates, options.rigid, options.hold_colours)
        if motion is None:
            rates = rates.cold(options.faster * settings.cold_start, options.several)
        else:
            rates = rates.warm(best.unexplained(options.usual))
        work = Work(previous, deformation, rates, views, self._picture, dict(carried))
        work.tells = self.tells
        for start in self._hooks.start:
            start(work)
        tables = free_tables(deformation, work.rates)  # a hook may have set where the layers start
        if not self._follows and best.stands(options.enough, options.confirm):
            stopping = Stopping(0)
        watch.lap("start")
        while (iteration := trace.iterations) < (planned := stopping.planned(iteration)):
            deformation.rest(work.rates.resting(iteration, planned))
            deformation.forward()
            work.features[:, :3] = work.colours
            watch.lap("cascade")
            met = len(trace.first)
            loss = self._pictures(plan.take(), work, trace, watch, planned - iteration - 1)
            work.sample = samples[iteration % len(samples)]
            for term in self._hooks.loss:
                loss += term(work)
            watch.lap("effects")
            loss += self._length * deformation.backward(work.gradients.means, work.gradients.factors, self._length)
            watch.lap("cascade backward")
            for table in tables:
                table.step(iteration, planned)
            for step in self._hooks.step:
                step(work, iteration, planned)
            watch.lap("adam")
            trace.losses.append(loss)
            trace.moments.append(watch.total)
            watch.lap(REPORT)
            if options.gate is not None and met < len(trace.first) == len(views):  # each camera was rendered once
                trace.left_out.update(options.gate(trace.first))
                plan.leave_out(trace.left_out)
                work.views = [view for view in views if view.name not in trace.left_out]
                watch.lap("judge")
            if stopping.looks(trace.iterations):
                stopping.saw(trace.iterations, best.error(work.look))
                watch.lap("looks")
        deformation.forward()
        trace.planned, trace.errors, trace.whole = stopping.planned_so_far, best.errors, best.whole
        trace.kept = work.kept = best.end(work.look, trace.iterations, trace.left_out)
        watch.lap("end")
        state = previous if work.kept is Candidate.STILL else self._commit(previous)
        for end in self._hooks.end:
            state = end(work, state)
        found = Motion.of(deformation, best.seconds)
        counts = [deformation.guards, self._picture.rasterizer.guards, *self._hooks.guards]
        acted = summed([*counts, *(table.guards for table in tables)])
        trace.guards = {name: count for name, count in acted.items() if count}
        watch.lap("commit")
        trace.seconds = watch.seconds
        return UpdateResult(state, found, trace, carried=work.carried, views=views)

    def _pictures(
        self, views: list[TrainingView], work: Work, trace: UpdateTrace, watch: Stopwatch, left: int
    ) -> float:
        """Image and mask loss, the mean over the views; ``work`` gets the gradients, of a single view the buffers.

        Args:
            left: iterations that are planned after this one.
        """
        deformation, picture = self._deformation, self._picture
        loss, total = 0.0, None
        for view in views:
            for show in self._hooks.show:
                show(work, view)
            found = picture.evaluate(
                deformation.means, deformation.factors, work.previous.opacities, work.features, view, watch.lap
            )
            for saw in self._hooks.saw:
                saw(work, view, picture, found)
            loss += picture.image_part + picture.mask_part
            trace.see(view, picture, left)
            watch.lap(REPORT)
            if len(views) == 1:
                work.gradients = found
                return loss
            if total is None:
                total = Gradients(*(array.copy() for array in found))
            else:
                for array, more in zip(total, found, strict=True):
                    array += more
        assert total is not None  # an iteration has a view
        for array in total:
            array /= len(views)
        work.gradients = total
        watch.lap("render backward")
        return loss / len(views)

    def _commit(self, previous: Gaussians) -> Gaussians:
        """Θ_t; the material rotation is the turn after all turns before."""
        rows = self.hierarchy.rows
        rotations = previous.rotations.copy()
        turned = quaternion_products(self._deformation.turns, previous.rotations[rows])
        rotations[rows] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
        means, factors = self._deformation.means.copy(), self._deformation.factors.copy()
        return previous.replace(means=means, factors=factors, rotations=rotations)
