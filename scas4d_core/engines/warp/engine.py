"""GPU engine: one iteration of an update in Warp, in the order of algorithm 1."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import warp as wp
from numpy.typing import NDArray

from scas4d_core.engines.cpu.gloss import LearntGloss, features_seen, without_turn
from scas4d_core.engines.engine import AttemptStart, IterationLog, StepScalars, Tables, Thinned, ViewRecord
from scas4d_core.engines.gains import GainEstimator
from scas4d_core.engines.plan import Structure, UpdatePlan
from scas4d_core.engines.renderer import psnr_of
from scas4d_core.engines.views import LABEL, TrainingView
from scas4d_core.engines.warp.adam import Adam
from scas4d_core.engines.warp.colours import WarpColours
from scas4d_core.engines.warp.deformation import WarpDeformation
from scas4d_core.engines.warp.layout import IMAGE_LOSS, MASK_LOSS, SHIFT, SQUARES
from scas4d_core.engines.warp.pictures import PicturePass
from scas4d_core.engines.warp.renderer import WarpRenderer
from scas4d_core.gaussians import Gaussians, turned_rotations
from scas4d_core.guards import GuardCounts, summed

Array = NDArray[np.float32]


class WarpEngine:
    """The ``UpdateEngine`` based on NVIDIA Warp, on a GPU or on Warp's CPU device.

    Kernels are launched individually, and the host reads the overflow flag after each rendering. Gloss and camera gains
    are computed on the host from downloaded pictures and gradients.

    Args:
        device: Warp device, such as "cpu" or "cuda:0".

    Attributes:
        renderer: renderer of states with the background and limits of the plan.
    """

    name = "warp"
    renderer: WarpRenderer

    def __init__(self, device: str = "cuda:0") -> None:
        self._device = device

    def bind(self, plan: UpdatePlan, structure: Structure) -> None:
        """See ``UpdateEngine.bind``; this engine supports all options of a plan."""
        self._plan, self._structure, self._rows = plan, structure, structure.hierarchy.rows
        self.renderer = WarpRenderer(plan.background, plan.limits, self._device, plan.image)
        self._deformation = WarpDeformation(self._device, plan, structure)
        self._pictures = PicturePass(self._device, plan, len(structure.roots))
        self._camera_rows = {name: row for row, name in enumerate(plan.cameras)}
        self._views: list[TrainingView] = []
        self._probes: list[TrainingView] = []
        self._view, self._record = (wp.zeros(1, dtype=wp.int32, device=self._device) for _ in range(2))

    def load_views(self, views: Sequence[TrainingView], probes: Sequence[TrainingView]) -> None:
        """See ``UpdateEngine.load_views``; if gains are estimated, the views get their own copies of the exposures."""
        self._views, self._probes = list(views), list(probes)
        if self._plan.camera_gains:
            exposures = {view.name: view.exposure.copy() for view in views}
            self._views = [replace(view, exposure=exposures[view.name]) for view in views]
            self._probes = [replace(view, exposure=exposures[view.name]) for view in probes]
        self._pictures.load_views([*self._views, *self._probes])

    def load_state(self, previous: Gaussians) -> None:
        """See ``UpdateEngine.load_state``."""
        self._previous, device = previous, self._device
        self._deformation.start(previous)
        self._pictures.forget_guards()
        self._opacities = wp.array(previous.opacities, dtype=wp.float32, device=device)
        self._features = wp.array(previous.features(previous.colours), dtype=wp.float32, ndim=2, device=device)
        self._gloss: LearntGloss | None = None
        self._gains: GainEstimator | None = None
        self._colours: WarpColours | None = None
        self._layer_steps: list[Adam] = []
        self._own_step: Adam | None = None
        self._log = IterationLog()

    def set_tables(self, tables: Tables) -> None:
        """See ``UpdateEngine.set_tables``."""
        self._deformation.set_tables(tables)

    def begin(self, start: AttemptStart) -> None:
        """See ``UpdateEngine.begin``."""
        plan, previous, deformation = self._plan, self._previous, self._deformation
        self._start, self._log = start, IterationLog()
        betas = start.beta1, start.beta2
        if plan.colours is not None:
            self._colours = WarpColours(plan, self._features, previous.colours, self._rows, start)
        if plan.gloss and previous.gloss is not None and previous.environment is not None:
            roots = self._structure.roots
            self._gloss = LearntGloss(previous.gloss, previous.environment, len(previous), self._rows, roots)
        if start.gains is not None:
            self._gains = GainEstimator(start.gains, self._camera_rows, self._views)
            self._expose()
        self._layer_steps = [
            Adam(table, rates, betas) for table, rates in zip(deformation.clusters, start.cluster_columns, strict=True)
        ]
        self._own_step = Adam(deformation.deltas, start.delta_columns, betas)
        deformation.set_samples(list(start.samples))

    def iterate(self, views: Sequence[int], step: StepScalars) -> None:
        """See ``UpdateEngine.iterate``."""
        deformation, pictures, lap = self._deformation, self._pictures, self._start.lap
        deformation.forward()
        lap("cascade")
        for gradient in (pictures.grad_means, pictures.grad_factors, pictures.grad_features):
            gradient.zero_()
        rows = [self._picture(index, 1.0 / len(views), step) for index in views]
        lap("render backward")
        deformation.backward(pictures.grad_means, pictures.grad_factors, step)
        if self._colours is not None:
            self._colours.backward(_as_table(pictures.grad_features), deformation.loss)
        lap("cascade backward")
        self._step(step)
        loss = sum(row[IMAGE_LOSS] + row[MASK_LOSS] for row in rows) / len(views)
        self._log.losses.append(float(loss + deformation.loss.numpy()[0]))
        lap("adam")

    def _picture(self, index: int, weight: float, step: StepScalars) -> Array:
        """Renders a view, backpropagates its loss times a weight, and returns its row of the log."""
        view, deformation, pictures = self._views[index], self._deformation, self._pictures
        if self._gloss is None:
            row = self._launched(index, _as_rows(self._features), weight)
        else:
            means, turns = deformation.means.numpy(), deformation.turns.numpy()
            seen, total = self._features.numpy().copy(), pictures.grad_features.numpy().copy()
            colours = np.ascontiguousarray(seen[:, :LABEL])
            self._gloss.shade(means, turns, colours, view.camera, seen)
            pictures.grad_features.zero_()
            row = self._launched(index, wp.array(seen, dtype=wp.vec4, device=self._device), weight)
            own = pictures.grad_features.numpy() / np.float32(weight)
            self._gloss.shade_backward(means, colours, view.camera, own)
            pictures.grad_features.assign(total + np.float32(weight) * own)
        if self._gains is not None or step.keep_pictures:
            height, width = view.target.shape[1:]
            planes = pictures.planes.numpy()[:, :height, :width]
            if step.keep_pictures:
                self._log.keep(index, Thinned.of(planes[: LABEL + 1], planes[LABEL + 1]))
            if self._gains is not None:
                self._gains.record_rendering(view, planes[:LABEL])
                self._expose()
        self._log.rendered.append(record_of(index, row, view))
        return row

    def _launched(self, index: int, features: wp.array, weight: float) -> Array:
        """Renders a view, adds its gradients times a weight, and returns its row of the log."""
        deformation, pictures = self._deformation, self._pictures
        given = (self._view, self._record, deformation.means, deformation.factors, self._opacities, features)
        return self._until_it_fits(index, lambda: pictures.launch(*given, weight))

    def _until_it_fits(self, index: int, render: Callable[[], None]) -> Array:
        """Renders a loaded view, again with larger lists after an overflow; returns its row of the log."""
        self._view.fill_(index)
        render()
        while self._pictures.grow():  # the picture was empty and no gradient was added
            render()
        row: Array = self._pictures.log.numpy()[0]
        return row

    def _step(self, step: StepScalars) -> None:
        """Steps Adam for all free parameters."""
        deformation = self._deformation
        for adam, gradient, factor in zip(self._layer_steps, deformation.cluster_gradients, step.layers, strict=True):
            adam.step(gradient, factor)
        assert self._own_step is not None  # set by `begin`
        self._own_step.step(deformation.delta_gradients, step.own)
        if self._colours is not None:
            self._colours.step(step.colour)
        if self._gloss is not None:
            self._gloss.step(step.gloss, step.smooth_gloss)

    def _expose(self) -> None:
        """Uploads the exposures of the views and probes to the device."""
        views = [*self._views, *self._probes]
        exposures = np.zeros((len(views), LABEL + 1, 2), np.float32)
        exposures[..., 0] = 1
        for row, view in enumerate(views):
            exposures[row, : len(view.exposure)] = view.exposure
        self._pictures.exposures.assign(exposures)

    def leave_out(self, views: Sequence[int]) -> None:
        """See ``UpdateEngine.leave_out``."""
        if self._gains is not None:
            self._gains.leave_out([self._views[index] for index in views])

    def wait(self, iteration: int) -> None:
        """See ``UpdateEngine.wait``."""
        wp.synchronize_device(self._device)

    def probe(self, which: Sequence[int], *, moved: bool, learnt: bool) -> list[float]:
        """See ``UpdateEngine.probe``."""
        deformation, pictures, state, turns = self._deformation, self._pictures, self._previous, None
        means, factors = deformation.previous
        if moved:
            deformation.forward()
            means, factors = deformation.means, deformation.factors
        if learnt:
            state = self._with_looks(state)
        if state.gloss is not None and moved:
            state = state.replace(means=means.numpy())
            turns = without_turn(len(state))
            turns[self._rows] = deformation.turns.numpy()
        errors = []
        for index in which:
            seen = features_seen(state, self._probes[index].camera, turns)
            features = wp.array(seen, dtype=wp.vec4, device=self._device)
            given = (self._view, self._record, means, factors, self._opacities, features)
            row = self._until_it_fits(len(self._views) + index, partial(pictures.measure, *given))
            errors.append(float(row[IMAGE_LOSS]))
        return errors

    def tables(self) -> Tables:
        """See ``UpdateEngine.tables``."""
        return self._deformation.tables()

    def log(self) -> IterationLog:
        """See ``UpdateEngine.log``."""
        steps = [*self._layer_steps, *([] if self._own_step is None else [self._own_step])]
        counts: list[GuardCounts] = [self._pictures.guards(), *(step.guards() for step in steps)]
        if self._colours is not None:
            counts.append(self._colours.guards())
        acted = dict(summed(counts)) | {"held_back": self._deformation.held_back}
        self._log.guards = {name: count for name, count in acted.items() if count}
        return self._log

    def state(self, learnt: bool) -> Gaussians:
        """See ``UpdateEngine.state``."""
        previous, deformation = self._previous, self._deformation
        deformation.forward()
        rotations = turned_rotations(previous.rotations, self._rows, deformation.turns.numpy())
        means, factors = deformation.means.numpy().copy(), deformation.factors.numpy().copy()
        moved = previous.replace(means=means, factors=factors, rotations=rotations)
        return self._with_looks(moved) if learnt else moved

    def exposures(self) -> Mapping[str, Array]:
        """See ``UpdateEngine.exposures``."""
        return {view.name: view.exposure.copy() for view in self._views}

    def gains(self) -> Array:
        """See ``UpdateEngine.gains``."""
        if self._gains is None:
            raise ValueError("gains were not given to begin; the plan has to follow them (UpdatePlan.camera_gains)")
        self._gains.finish_round()
        self._expose()
        return self._gains.gains.copy()

    def gradients(self) -> dict[str, Array]:
        """See ``UpdateEngine.gradients``; those of frozen layers are not up to date."""
        deformation = self._deformation
        tables = {f"cluster {k}": table.numpy().copy() for k, table in enumerate(deformation.cluster_gradients)}
        tables["deltas"] = deformation.delta_gradients.numpy().copy()
        if self._colours is not None:
            tables["colours"] = self._colours.gradients.numpy().copy()
        if self._gloss is not None:
            tables["gloss"], tables["environment"] = (gradient.copy() for gradient in self._gloss.gradients)
        return tables

    def _with_looks(self, state: Gaussians) -> Gaussians:
        """Returns a state with the colours, gloss and environment learned so far."""
        state = state.replace(colours=np.ascontiguousarray(self._features.numpy()[:, :LABEL]))
        if self._gloss is None:
            return state
        return state.replace(gloss=self._gloss.gloss.copy(), environment=self._gloss.environment.copy())


def record_of(index: int, row: Array, view: TrainingView) -> ViewRecord:
    """Returns the record of a rendering from its row of the device's log."""
    height, width = view.target.shape[1:]
    red, green, blue = row[SHIFT : SHIFT + LABEL].tolist()
    return ViewRecord(index, psnr_of(float(row[SQUARES]), height * width), (red, green, blue))


def _as_rows(table: wp.array) -> wp.array:
    """Views a table [N, 4] as [N] of vec4 without copying."""
    return wp.array(ptr=table.ptr, dtype=wp.vec4, shape=table.shape[0], device=table.device)


def _as_table(rows: wp.array) -> wp.array:
    """Views [N] of vec4 as a table [N, 4] without copying."""
    return wp.array(ptr=rows.ptr, dtype=wp.float32, shape=(rows.shape[0], 4), device=rows.device)
