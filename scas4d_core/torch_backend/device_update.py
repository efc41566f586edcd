"""Update of one frame on a torch device: ``TorchUpdate`` behind the interface of ``frame_update.Updater``.

On "cuda" gsplat rasterizes; on "cpu" the dense twin does, which is slow and exact and there for tests. The order of
views, the samples, the rates, the hierarchy and the warm start are those of the CPU. Not yet run on a GPU.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import chain
from time import perf_counter

import numpy as np
import torch
from numpy.typing import NDArray

from scas4d_core.effects.appearance.colours import Colours
from scas4d_core.effects.coherence.neighbour_terms import NeighbourTerms
from scas4d_core.effects.parts import NOTHING, Arrays, Hooks, PartsBuilder, Work, not_on_devices
from scas4d_core.effects.switches import joined
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians
from scas4d_core.rasterize.limits import scene_limits
from scas4d_core.settings import SceneSettings, UpdateSettings
from scas4d_core.structure.hierarchy import Hierarchy
from scas4d_core.structure.neighbours import Neighbours
from scas4d_core.torch_backend.arrays import ClusterArrays, DeltaArrays, Graph, TermWeights, TorchResult, TorchView
from scas4d_core.torch_backend.update import TorchUpdate
from scas4d_core.update import deformation, schedule
from scas4d_core.update.best_state import BestState, ProbeViews
from scas4d_core.update.deformation import CpuDeformation, first_lengths, length_bounds
from scas4d_core.update.free_tables import freed
from scas4d_core.update.picture_loss import LABEL, PictureLoss, ViewFactory
from scas4d_core.update.rates import Rates
from scas4d_core.update.result import AS_SET, AttemptOptions, Stopwatch, UpdateResult, UpdateTrace, camera_fit
from scas4d_core.update.schedule import Stopping, ViewPlan, plan_samples
from scas4d_core.update.training_view import TrainingView
from scas4d_core.update.warm_start import Motion, predicted

Array = NDArray[np.float32]


@dataclass(eq=False)
class Tables:
    """``warm_start.Parameters`` as ``TorchUpdate`` takes and returns them."""

    hierarchy: Hierarchy
    clusters: list[Array]
    deltas: Array

    @classmethod
    def of(cls, hierarchy: Hierarchy, found: TorchResult) -> Tables:
        """The parameters that an update found."""
        clusters = [np.concatenate([p.r, p.t, p.c, p.s[:, None]], axis=1) for p in found.layers]
        return cls(hierarchy, clusters, np.concatenate(found.deltas, axis=1))

    def split(self) -> tuple[list[ClusterArrays], DeltaArrays]:
        """The same as ``TorchUpdate`` takes it."""
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
        parts: PartsBuilder | None = None,
        device: str = "cuda",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self.settings = settings
        self.hierarchy = hierarchy
        self._factory = factory
        limits = scene_limits(scene.near, factory.rig.radius)
        parts = parts or joined(PartsBuilder(scene, settings, factory, hierarchy, first))
        self._picture = PictureLoss(factory, scene.behind, schedule.IMAGE_WEIGHT, parts.mask, limits=limits)
        self._freedom, self._follows = parts.freedom, parts.follows
        own = [part for part in parts.parts if not part.known_to_devices]
        for part in own:
            if hooks := not_on_devices(type(part)):
                raise ValueError(f"{type(part).__name__}: an update on a device calls no {', '.join(hooks)}")
        self._hooks = Hooks(own)
        bounds = length_bounds(hierarchy, first)
        self._deformation = CpuDeformation(hierarchy, neighbours, bounds, settings.cluster_map, settings.covariance)
        self._update = TorchUpdate(
            moving=hierarchy.rows,
            labels=[labels.astype(np.int64) for labels in hierarchy.labels],
            graph=_graph(neighbours, len(hierarchy.rows)),
            first_lengths=first_lengths(hierarchy, first),
            rates=_rates(Rates.of(settings, len(hierarchy.sizes), factory.rig.reach), parts),
            weights=_weights(parts, neighbours is not None),
            terms=tuple(part.twin for part in parts.parts),
            max_scale=deformation.MAX_SCALE,
            background=scene.behind,
            cluster_map=settings.cluster_map,
            covariance=settings.covariance,
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
        options: AttemptOptions = AS_SET,
        carried: Mapping[str, Arrays] = NOTHING,
    ) -> UpdateResult:
        """Find D_t and apply it, see ``frame_update.Updater.run``; no gate is asked.

        The candidates are compared on a few small pictures that the CPU renders, as in ``FrameUpdate``.
        """
        settings, hierarchy, deformation = self.settings, self.hierarchy, self._deformation
        stopping = options.stopping or Stopping(settings.iterations)
        most, motion = stopping.most, predicted(motion, self._freedom)
        rng = np.random.default_rng([settings.seed, seed])
        watch, trace = Stopwatch(), UpdateTrace()
        deformation.start(previous)
        probes = ProbeViews(self._factory, self._picture, views if options.compare else [])
        best = BestState(probes, deformation, previous, motion, seconds, settings.momentum)
        best.start(options.step)
        rates = self._update.rates.tried(options.rates, options.rigid, options.hold_colours)
        if motion is None:
            rates = rates.cold(options.faster * settings.cold_start, options.several)
        else:
            rates = rates.warm(best.unexplained(options.usual))
        work = Work(previous, deformation, rates, views, self._picture, dict(carried))
        for begin in self._hooks.start:
            begin(work)
        stands = not self._follows and best.stands(options.enough, options.confirm)
        if stands:
            stopping = Stopping(0)
        plan = ViewPlan(views, settings.views, most, rng)
        pictures = [plan.take() for _ in range(0 if stands else most)]
        samples = plan_samples(len(hierarchy.rows), rng)
        update = replace(self._update, rates=rates)
        start, deltas = Tables(hierarchy, deformation.clusters, deformation.deltas).split()
        distinct = {id(view): view for seen in pictures for view in seen}
        place = {key: index for index, key in enumerate(distinct)}
        watch.lap("start")
        found = update.run(
            previous,
            [self._on_device(view) for view in distinct.values()],
            [[place[id(view)] for view in seen] for seen in pictures],
            start=start,
            deltas=deltas,
            rows=[samples[iteration % len(samples)] for iteration in range(most)],
            on_iteration=lambda _: trace.moments.append(perf_counter() - watch.began),
            stopping=stopping,
            look=best.error_of,
        )
        watch.lap("iterations")
        if trace.moments:
            trace.moments[-1] = watch.total  # a device may be behind its host: it is through here
        trace.losses, trace.psnr, trace.planned = found.losses, found.psnr, stopping.planned_so_far
        trace.cameras = {view.name: camera_fit(psnr) for view, psnr in zip(chain(*pictures), found.psnr, strict=False)}
        _take(deformation, Tables.of(hierarchy, found))
        deformation.forward()
        trace.errors, trace.whole = best.errors, best.whole
        trace.kept = best.end(found.gaussians, trace.iterations, {})
        watch.lap("end")
        state = found.gaussians if trace.kept is Candidate.END else previous
        if trace.kept is Candidate.WARM:
            start, deltas = Tables(hierarchy, deformation.clusters, deformation.deltas).split()
            state = update.run(previous, [], [], start=start, deltas=deltas).gaussians
        work.colours, work.kept = found.gaussians.colours, trace.kept
        for end in self._hooks.end:
            state = end(work, state)
        motion_found = Motion.of(deformation, best.seconds)
        watch.lap("commit")
        trace.seconds = watch.seconds
        return UpdateResult(state, motion_found, trace, carried=work.carried, views=views)

    def _on_device(self, view: TrainingView) -> TorchView:
        """The view as ``TorchUpdate`` takes it."""
        camera = self._factory.posed[view.name]
        target = np.moveaxis(view.target, 0, -1)
        mask = target[..., LABEL] if target.shape[-1] > LABEL else None
        return TorchView(camera, target[..., :LABEL], mask, view.exposure[:LABEL])


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


def _rates(rates: Rates, parts: PartsBuilder) -> Rates:
    """The rates with those of parameters that no effect frees at 0: these are in no group of Adam."""
    moving, standing = (parts.find(Colours) or Colours(parts)).freed(rates)
    return replace(freed(rates, parts.freedom), colour=moving, colour_standing=standing)


def _weights(parts: PartsBuilder, tied: bool) -> TermWeights:
    """The weights of the terms; those between neighbours only where there are any."""
    ties = parts.find(NeighbourTerms)
    rigidity, isometry, rotation = ties.strengths if tied and ties is not None else (0.0, 0.0, 0.0)
    return TermWeights(
        image=schedule.IMAGE_WEIGHT,
        mask=parts.mask,
        rigidity=rigidity,
        isometry=isometry,
        rotation=rotation,
        scale=parts.length,
        soft_colour=schedule.SOFT_COLOUR_WEIGHT,
    )
