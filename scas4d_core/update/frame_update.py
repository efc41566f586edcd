"""One frame: from Θ_{t−1} and the pictures of frame t to Θ_t (paper, algorithm 1). The loop is ``FrameUpdate.run``."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from scas4d_core.gaussians import Gaussians
from scas4d_core.guards import summed
from scas4d_core.rasterize.cpu import Gradients
from scas4d_core.rasterize.limits import scene_limits
from scas4d_core.robust.attempts import Course, Manner
from scas4d_core.settings import SceneSettings, UpdateSettings
from scas4d_core.structure.hierarchy import Hierarchy
from scas4d_core.structure.neighbours import Neighbours
from scas4d_core.update.adam import Adam
from scas4d_core.update.best_state import Anytime
from scas4d_core.update.deformation import CpuDeformation
from scas4d_core.update.floor import floor_term
from scas4d_core.update.picture_loss import PictureLoss
from scas4d_core.update.result import REPORT, Stopwatch, Story, Updated
from scas4d_core.update.schedule import Rates, ViewPlan, first_lengths, mask_weight, plan_samples
from scas4d_core.update.stopping import Counted
from scas4d_core.update.views import TrainingView, ViewFactory
from scas4d_core.update.warm_start import Motion, quaternion_products

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
        course: Course | None = None,
    ) -> Updated:
        """Find D_t and apply it.

        Args:
            previous: Θ_{t−1}. views: of frame t. motion: what the previous update left, or None.
            seconds: between the frames. seed: of the order of views and the sampled neighbourhoods.
            course: how long and in which manner; None: the settings' iterations, as set.
        """


class FrameUpdate:
    """The ``Updater`` of the CPU; buffers are kept from frame to frame.

    Attributes:
        tells: whether what the report alone asks for is worked out; the state is the same without.
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
        self._picture = PictureLoss(factory, scene.background, weights.image, mask, limits=limits)
        bounds = np.maximum(first_lengths(hierarchy, first), np.float32(settings.max_scale))
        self._deformation = CpuDeformation(hierarchy, neighbours, bounds, settings.cluster_map, settings.covariance)

    def run(
        self,
        previous: Gaussians,
        views: list[TrainingView],
        motion: Motion | None,
        seconds: float,
        seed: int,
        course: Course | None = None,
    ) -> Updated:
        """Find D_t and apply it, see ``Updater.run``."""
        settings, deformation = self.settings, self._deformation
        course = course or Course(Counted(settings.iterations))
        rng = np.random.default_rng([settings.seed, seed])
        watch = Stopwatch()
        plan = ViewPlan(self._factory, views, settings, course.pace.most, rng)
        samples = plan_samples(len(self.hierarchy.rows), settings.neighbour_sample, rng)
        features = np.concatenate([previous.colours, previous.foreground[:, None]], axis=1)
        colours = previous.colours.copy()
        counts = (deformation.guards, self._picture.rasterizer.guards)
        for guards in counts:
            guards.reset()
        deformation.start(previous)
        anytime = Anytime.of(self._factory, self._picture, deformation, previous, views if course.witness else [])
        seconds = anytime.start(motion, seconds, settings, course.step)
        optimizers = self._optimizers(colours, course.manner, cold=motion is None)
        soft = np.float32(settings.weights.soft_colour / max(colours.size, 1))  # of the mean absolute change of colour
        pace = Counted(0) if anytime.stands(course.enough) else course.pace
        story = Story(len(views), self.tells)
        watch.lap("start")
        while (iteration := story.iterations) < (planned := pace.planned(iteration)):
            seen = plan.take(iteration, planned)
            deformation.forward()
            features[:, :3] = colours
            watch.lap("cascade")
            loss, gradients = self._pictures(seen, previous.opacities, features, story, watch)
            loss += self._neighbour_terms(samples[iteration % len(samples)])
            if self._floor is not None:
                loss += floor_term(
                    self._floor, deformation.means, self.hierarchy.rows, settings.weights.floor, gradients.means
                )
            watch.lap("neighbours")
            weight = settings.weights.scale
            loss += weight * deformation.backward(gradients.means, gradients.factors, weight)
            watch.lap("cascade backward")
            change = colours - previous.colours
            g_colours = gradients.features[:, :3] + soft * np.sign(change)
            tables = [*deformation.cluster_gradients, deformation.delta_gradients, g_colours]
            for optimizer, table in zip(optimizers, tables, strict=True):
                optimizer.step(table, iteration, planned)
            watch.lap("adam")
            if self.tells:
                loss += float(soft * np.abs(change).sum(dtype=np.float64))
            complete = story.end_iteration(loss, watch.total)
            watch.lap(REPORT)
            if complete and course.gate is not None:
                plan.leave_out(story.leave_out(course.gate(story.first)))
                watch.lap("judge")
            if pace.looks(story.iterations):
                pace.saw(story.iterations, anytime.error(colours))
                watch.lap("looks")
        deformation.forward()
        kept = anytime.end(colours, story)
        watch.lap("end")
        state = previous if kept == "still" else self._commit(previous, colours if kept == "end" else previous.colours)
        updated = story.updated(state, Motion.of(deformation, seconds), pace, anytime.errors, kept)
        acted = summed([*counts, *(optimizer.guards for optimizer in optimizers)])
        updated.guards.update({name: count for name, count in acted.items() if count})
        watch.lap("commit")
        updated.seconds.update(watch.seconds)
        return updated

    def _optimizers(self, colours: Array, manner: Manner, cold: bool) -> list[Adam]:
        """One per table: each layer of clusters, the Gaussians' own deltas, the colours. Moments start at zero."""
        rates = self._rates.tried(manner.rates, manner.rigid, manner.hold_colours)
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

    def _pictures(
        self, views: list[TrainingView], opacities: Array, features: Array, story: Story, watch: Stopwatch
    ) -> tuple[float, Gradients]:
        """Image and mask loss, the mean over the views, and its gradients; a single view's are the rasterizer's own."""
        deformation, picture = self._deformation, self._picture
        loss, total = 0.0, None
        for view in views:
            found = picture.evaluate(deformation.means, deformation.factors, opacities, features, view, watch.lap)
            loss += picture.image_part + picture.mask_part
            story.see(view, picture)
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
