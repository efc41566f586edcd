"""One frame's update on a torch device: ``update_torch`` behind the interface of ``update.FrameUpdate``.

On "cuda" gsplat rasterizes; on "cpu" the dense twin does, which is slow and exact and there for tests. The order of
views, the samples, the rates, the hierarchy and the warm start are those of the CPU. Not yet run on a GPU.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain
from time import perf_counter

import numpy as np
import torch
from numpy.typing import NDArray

from scas4d_core.gaussians import Gaussians
from scas4d_core.rasterize.limits import scene_limits
from scas4d_core.robust.attempts import Course
from scas4d_core.settings import SceneSettings, UpdateSettings
from scas4d_core.structure.hierarchy import Hierarchy
from scas4d_core.structure.neighbours import Neighbours
from scas4d_core.torch_backend import update as update_torch
from scas4d_core.torch_backend.update import ClusterArrays, DeltaArrays, Graph, TermWeights, TorchUpdate
from scas4d_core.update.best_state import Anytime
from scas4d_core.update.deformation import CpuDeformation
from scas4d_core.update.picture_loss import PictureLoss
from scas4d_core.update.result import CameraFit, Stopwatch, Story, Updated
from scas4d_core.update.schedule import Rates, ViewPlan, first_lengths, mask_weight, plan_samples
from scas4d_core.update.stopping import Counted
from scas4d_core.update.views import LABEL, TrainingView, ViewFactory
from scas4d_core.update.warm_start import Motion

Array = NDArray[np.float32]


@dataclass(eq=False)
class Tables:
    """``warm_start.Parameters`` as ``update_torch`` gives and takes them."""

    hierarchy: Hierarchy
    clusters: list[Array]
    deltas: Array

    @classmethod
    def of(cls, hierarchy: Hierarchy, found: update_torch.Updated) -> Tables:
        """What an update found."""
        clusters = [np.concatenate([p.r, p.t, p.c, p.s[:, None]], axis=1) for p in found.layers]
        return cls(hierarchy, clusters, np.concatenate(found.deltas, axis=1))

    def split(self) -> tuple[list[ClusterArrays], DeltaArrays]:
        """The same as ``update_torch`` takes it."""
        layers = [ClusterArrays(v[:, :3], v[:, 3:6], v[:, 6:9], v[:, 9]) for v in self.clusters]
        return layers, DeltaArrays(self.deltas[:, :3], self.deltas[:, 3:6], self.deltas[:, 6:])


class DeviceUpdate:
    """The ``Updater`` of a torch device; its arguments are those of ``FrameUpdate``, and the device and dtype."""

    def __init__(
        self,
        factory: ViewFactory,
        scene: SceneSettings,
        settings: UpdateSettings,
        hierarchy: Hierarchy,
        neighbours: Neighbours | None,
        first: Gaussians,
        device: str = "cuda",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self.settings = settings
        self.hierarchy = hierarchy
        self._factory = factory
        weights = settings.weights
        mask = mask_weight(settings, len(hierarchy.rows), len(first))
        limits = scene_limits(scene.near, factory.rig.radius)
        self._picture = PictureLoss(factory, scene.background, weights.image, mask, limits=limits)
        lengths = first_lengths(hierarchy, first)
        bounds = np.maximum(lengths, np.float32(settings.max_scale))
        self._deformation = CpuDeformation(hierarchy, neighbours, bounds, settings.cluster_map, settings.covariance)
        self._update = TorchUpdate(
            moving=hierarchy.rows,
            labels=[labels.astype(np.int64) for labels in hierarchy.labels],
            graph=_graph(neighbours, len(hierarchy.rows)),
            first_lengths=lengths,
            rates=Rates.of(settings, len(hierarchy.sizes), factory.rig.radius),
            weights=_weights(settings, neighbours is not None, mask),
            max_scale=settings.max_scale,
            background=scene.background,
            cluster_map=settings.cluster_map,
            covariance=settings.covariance,
            floor=scene.floor,
            near=limits.near,
            device=device,
            dtype=dtype,
        )

    def run(
        self,
        previous: Gaussians,
        views: list[TrainingView],
        motion: Motion | None,
        seconds: float,
        seed: int,
        course: Course | None = None,
    ) -> Updated:
        """Find D_t and apply it, see ``update.Updater.run``; no gate is asked.

        Start and end are compared on a few small pictures that the CPU renders, as for ``update.FrameUpdate``.
        """
        settings, hierarchy = self.settings, self.hierarchy
        course = course or Course(Counted(settings.iterations))
        rng = np.random.default_rng([settings.seed, seed])
        watch = Stopwatch()
        deformation = self._deformation
        deformation.start(previous)
        anytime = Anytime.of(self._factory, self._picture, deformation, previous, views if course.witness else [])
        seconds = anytime.start(motion, seconds, settings, course.step)
        stands = anytime.stands(course.enough)
        pace = Counted(0) if stands else course.pace
        most = course.pace.most
        plan = ViewPlan(self._factory, views, settings, most, rng)
        pictures = [plan.take(iteration, settings.iterations) for iteration in range(0 if stands else most)]
        samples = plan_samples(len(hierarchy.rows), settings.neighbour_sample, rng)
        manner = course.manner
        rates = self._update.rates.tried(manner.rates, manner.rigid, manner.hold_colours)
        update = replace(self._update, rates=rates.hurried(settings.cold_start) if motion is None else rates)
        start, deltas = Tables(hierarchy, deformation.clusters, deformation.deltas).split()
        distinct = {id(view): view for seen in pictures for view in seen}
        place = {key: index for index, key in enumerate(distinct)}
        story = Story(len(views))
        watch.lap("start")
        found = update.run(
            previous,
            [self._on_device(view) for view in distinct.values()],
            [[place[id(view)] for view in seen] for seen in pictures],
            start=start,
            deltas=deltas,
            rows=[samples[iteration % len(samples)] for iteration in range(most)],
            on_iteration=lambda _: story.moments.append(perf_counter() - watch.began),
            pace=pace,
            look=anytime.error_of,
        )
        watch.lap("iterations")
        if story.moments:
            story.moments[-1] = watch.total  # a device may be behind its host: it is through here
        story.losses, story.psnr = found.losses, found.psnr
        story.last = {view.name: CameraFit(psnr) for view, psnr in zip(chain(*pictures), found.psnr, strict=False)}
        _take(deformation, Tables.of(hierarchy, found))
        kept = anytime.end(found.gaussians.colours, story)
        watch.lap("end")
        state = found.gaussians if kept == "end" else previous
        if kept == "warm":
            start, deltas = Tables(hierarchy, deformation.clusters, deformation.deltas).split()
            state = update.run(previous, [], [], start=start, deltas=deltas).gaussians
        updated = story.updated(state, Motion.of(deformation, seconds), pace, anytime.errors, kept)
        watch.lap("commit")
        updated.seconds.update(watch.seconds)
        return updated

    def _on_device(self, view: TrainingView) -> update_torch.TrainingView:
        """The view as ``update_torch`` takes it; a picture smaller than its camera's is a coarse one."""
        camera = self._factory.rig[view.name]
        if (camera.width, camera.height) != (view.camera.width, view.camera.height):
            camera = camera.scaled(self.settings.coarse_scale)
        target = np.moveaxis(view.target, 0, -1)
        mask = target[..., LABEL] if target.shape[-1] > LABEL else None
        return update_torch.TrainingView(camera, target[..., :LABEL], mask, view.exposure[:LABEL])


def _take(deformation: CpuDeformation, tables: Tables) -> None:
    """Set a deformation to what was found."""
    for values, given in zip(deformation.clusters, tables.clusters, strict=True):
        values[:] = given
    deformation.deltas[:] = tables.deltas


def _graph(neighbours: Neighbours | None, count: int) -> Graph:
    """The neighbours; without any, an empty graph that no term reads."""
    if neighbours is None:
        return Graph(np.zeros((count, 0), np.int64), np.zeros((count, 0)), np.zeros((count, 0)))
    return Graph(neighbours.index.astype(np.int64), neighbours.weights, neighbours.distances)


def _weights(settings: UpdateSettings, tied: bool, mask: float) -> TermWeights:
    """The weights of the terms; those between neighbours only where there are any."""
    given = settings.weights
    return TermWeights(
        image=given.image,
        mask=mask,
        rigidity=given.rigidity if tied else 0.0,
        isometry=given.isometry if tied else 0.0,
        rotation=given.rotation if tied else 0.0,
        scale=given.scale,
        soft_colour=given.soft_colour,
        floor=given.floor,
    )
