"""CPU engine for updates, which runs the steps of each iteration in the order given by algorithm 1."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.cpu.adam import AdamColumns
from scas4d_core.engines.cpu.changed_pixels import MOST, ChangedPixels
from scas4d_core.engines.cpu.colours import Colours
from scas4d_core.engines.cpu.deformation import CpuDeformation
from scas4d_core.engines.cpu.floor import floor_term
from scas4d_core.engines.cpu.gloss import LearntGloss, features_seen, without_turn
from scas4d_core.engines.cpu.renderer import CpuRenderer
from scas4d_core.engines.engine import (
    GAINS_MISSING,
    REPORT,
    AttemptStart,
    IterationLog,
    Probe,
    StepScalars,
    Tables,
    Thinned,
    ViewRecord,
)
from scas4d_core.engines.gains import GainEstimator
from scas4d_core.engines.plan import Structure, UpdatePlan
from scas4d_core.engines.renderer import Gradients
from scas4d_core.engines.views import TrainingView
from scas4d_core.gaussians import Gaussians, turned_rotations
from scas4d_core.guards import GuardCounts, summed

Array = NDArray[np.float32]


class CpuEngine:
    """The CPU implementation of ``UpdateEngine``. Buffers are allocated once per hierarchy and reused for every frame.

    Attributes:
        name: name of the engine, used in messages.
        renderer: renderer for states, with the plan's background, limits and weights.
    """

    name = "cpu"
    renderer: CpuRenderer

    def bind(self, plan: UpdatePlan, structure: Structure) -> None:
        """See ``UpdateEngine.bind``. This engine supports all plans."""
        hierarchy, count = structure.hierarchy, len(structure.roots)
        self._plan, self._structure, self._rows = plan, structure, hierarchy.rows
        given = (plan.background, plan.image, plan.mask)
        if plan.full_images or len(self._rows) > MOST * count:
            self.renderer = CpuRenderer(*given, limits=plan.limits)
        else:
            self.renderer = ChangedPixels(*given, self._rows, count, plan.limits)
        self._deformation = CpuDeformation(
            hierarchy, structure.neighbours, structure.length_bounds, plan.cluster_map, plan.covariance
        )
        self._camera_rows = {name: row for row, name in enumerate(plan.cameras)}
        self._views: list[TrainingView] = []
        self._probes: list[TrainingView] = []

    def load_views(self, views: Sequence[TrainingView], probes: Sequence[TrainingView]) -> None:
        """See ``UpdateEngine.load_views``. If gains are estimated, exposures are copied before they are modified."""
        self._views, self._probes = list(views), list(probes)
        if self._plan.camera_gains:  # later attempts must start from the original exposures
            exposures = {view.name: view.exposure.copy() for view in views}
            self._views = [replace(view, exposure=exposures[view.name]) for view in views]
            self._probes = [replace(view, exposure=exposures[view.name]) for view in probes]

    def load_state(self, previous: Gaussians) -> None:
        """See ``UpdateEngine.load_state``."""
        self._previous = previous
        self._deformation.guards.reset()
        self.renderer.rasterizer.guards.reset()
        self._deformation.start(previous)
        self.renderer.load_state(previous)
        self._colours = previous.colours.copy()
        self._features = previous.features(previous.colours)
        self._gloss: LearntGloss | None = None
        self._gains: GainEstimator | None = None
        self._colour_table: Colours | None = None
        self._layer_columns: list[AdamColumns | None] = []
        self._own_columns: AdamColumns | None = None
        self._log = IterationLog()
        self._deformed = False

    def set_tables(self, tables: Tables) -> None:
        """See ``UpdateEngine.set_tables``."""
        self._deformation.freeze_layers(0)
        for values, given in zip(self._deformation.clusters, tables.clusters, strict=True):
            values[:] = given
        self._deformation.deltas[:] = tables.deltas
        self._deformed = False

    def begin(self, start: AttemptStart) -> None:
        """See ``UpdateEngine.begin``."""
        plan, previous = self._plan, self._previous
        self._start, self._log = start, IterationLog()
        betas = start.beta1, start.beta2
        if plan.colours is not None:
            self._colour_table = Colours(
                self._colours, previous.colours, self._rows, plan.colours.static, plan.soft_colour, start
            )
        if plan.gloss and previous.gloss is not None and previous.environment is not None:
            roots = self._structure.roots
            self._gloss = LearntGloss(previous.gloss, previous.environment, len(previous), self._rows, roots)
        if start.gains is not None:
            self._gains = GainEstimator(start.gains, self._camera_rows, self._views)
        own = start.delta_columns
        deformation = self._deformation
        self._layer_columns = [
            AdamColumns(table, rates, betas) if any(rates) else None
            for table, rates in zip(deformation.clusters, start.cluster_columns, strict=True)
        ]
        self._own_columns = AdamColumns(deformation.deltas, own, betas) if any(own) else None

    def iterate(self, views: Sequence[int], step: StepScalars) -> None:
        """See ``UpdateEngine.iterate``."""
        deformation, lap = self._deformation, self._start.lap
        deformation.freeze_layers(step.frozen)
        deformation.forward()
        self._features[:, :3] = self._colours
        lap("cascade")
        loss, gradients = self._pictures(views, step)
        loss += self._terms(gradients, step)
        lap("effects")
        length = self._plan.axis_length
        loss += length * deformation.backward(gradients.means, gradients.factors, length)
        lap("cascade backward")
        self._step(step)
        self._deformed = False
        lap("adam")
        self._log.losses.append(loss)
        lap(REPORT)

    def _pictures(self, views: Sequence[int], step: StepScalars) -> tuple[float, Gradients]:
        """Returns the sum of the image and mask losses, averaged over views, and its gradients.

        If there is a single view, the gradients are renderer buffers.
        """
        loss, total = 0.0, None
        for index in views:
            view_loss, gradients = self._picture(index, step)
            loss += view_loss
            if len(views) == 1:
                return loss, gradients
            if total is None:
                total = Gradients(*(array.copy() for array in gradients))
            else:
                for array, more in zip(total, gradients, strict=True):
                    array += more
        assert total is not None  # an iteration has at least one view
        for array in total:
            array /= len(views)
        self._start.lap("render backward")
        return loss / len(views), total

    def _picture(self, index: int, step: StepScalars) -> tuple[float, Gradients]:
        """Renders a view, logs the result, and returns the sum of the image and mask losses with its gradients."""
        view, deformation, renderer, lap = self._views[index], self._deformation, self.renderer, self._start.lap
        if self._gloss is not None:
            self._gloss.shade(deformation.means, deformation.turns, self._colours, view.camera, self._features)
        gradients = renderer.forward_backward(
            deformation.means, deformation.factors, self._previous.opacities, self._features, view, lap
        )
        if self._gloss is not None:
            self._gloss.shade_backward(deformation.means, self._colours, view.camera, gradients.features)
        if self._gains is not None:
            height, width = view.target.shape[1:]
            self._gains.record_rendering(view, renderer.rasterizer.planes[:3, :height, :width])
        loss = renderer.image_part + renderer.mask_part
        self._log.rendered.append(ViewRecord(index, renderer.psnr, renderer.colour_shift(view)))
        if step.keep_pictures:
            self._log.keep(index, Thinned.of(*renderer.shown(view)))
        lap(REPORT)
        return loss, gradients

    def _terms(self, gradients: Gradients, step: StepScalars) -> float:
        """Returns the weighted sum of neighbour, floor and soft-colour losses.

        Their gradients are added to ``gradients`` or stored for the backward pass.
        """
        plan, deformation, loss = self._plan, self._deformation, 0.0
        if plan.neighbour_terms:
            weights = (step.rigidity, plan.isometry, plan.rotation)
            parts = deformation.neighbour_losses(self._start.samples[step.sample], weights)
            loss += float(np.dot(list(weights), parts))
        if plan.floor is not None:
            loss += floor_term(plan.floor, deformation.means, self._rows, plan.floor_weight, gradients.means)
        if self._colour_table is not None:
            loss += self._colour_table.loss(gradients.features)
        return loss

    def _step(self, step: StepScalars) -> None:
        """Takes an Adam step for all free parameters."""
        deformation = self._deformation
        for columns, gradient, factor in zip(
            self._layer_columns, deformation.cluster_gradients, step.layers, strict=True
        ):
            if columns is not None:
                columns.step(gradient, factor)
        if self._own_columns is not None:
            self._own_columns.step(deformation.delta_gradients, step.own)
        if self._colour_table is not None:
            self._colour_table.step(step.colour)
        if self._gloss is not None:
            self._gloss.step(step.gloss, step.smooth_gloss)

    def leave_out(self, views: Sequence[int]) -> None:
        """See ``UpdateEngine.leave_out``."""
        if self._gains is not None:
            self._gains.leave_out([self._views[index] for index in views])

    def wait(self, iteration: int) -> None:
        """See ``UpdateEngine.wait``. Does nothing, because the host itself is the device."""

    def probe(self, *probes: Probe, state_next: bool = False) -> list[list[float]]:
        """See ``UpdateEngine.probe``."""
        return [self._losses(probe) for probe in probes]

    def _losses(self, probe: Probe) -> list[float]:
        """Returns the image loss on each view of a probe."""
        state, turns = self._previous, None
        if probe.learnt:
            state = self._with_looks(state)
        if probe.moved:
            self._forward()
            if state.gloss is not None:
                turns = without_turn(len(state))
                turns[self._rows] = self._deformation.turns
            state = state.replace(means=self._deformation.means, factors=self._deformation.factors)
        losses = []
        for index in probe.views:
            view = self._probes[index]
            features = features_seen(state, view.camera, turns)
            self.renderer.forward(state.means, state.factors, state.opacities, features, view)
            losses.append(self.renderer.image_part)
        return losses

    def tables(self) -> Tables:
        """See ``UpdateEngine.tables``."""
        return Tables(self._deformation.clusters, self._deformation.deltas).copy()

    def log(self) -> IterationLog:
        """See ``UpdateEngine.log``."""
        steps = [self._colour_table, self._own_columns, *self._layer_columns]
        counts: list[GuardCounts] = [self._deformation.guards, self.renderer.rasterizer.guards]
        counts += [table.guards for table in steps if table is not None]
        self._log.guards = {name: count for name, count in summed(counts).items() if count}
        return self._log

    def state(self, learnt: bool) -> Gaussians:
        """See ``UpdateEngine.state``."""
        self._forward()
        previous, deformation = self._previous, self._deformation
        rotations = turned_rotations(previous.rotations, self._rows, deformation.turns)
        moved = previous.replace(
            means=deformation.means.copy(), factors=deformation.factors.copy(), rotations=rotations
        )
        if not learnt:
            return moved
        moved = self._with_looks(moved)
        gloss = None if moved.gloss is None else moved.gloss.copy()
        environment = None if moved.environment is None else moved.environment.copy()
        return moved.replace(colours=moved.colours.copy(), gloss=gloss, environment=environment)

    def exposures(self) -> Mapping[str, Array]:
        """See ``UpdateEngine.exposures``."""
        return {view.name: view.exposure.copy() for view in self._views}

    def gains(self) -> Array:
        """See ``UpdateEngine.gains``."""
        if self._gains is None:
            raise ValueError(GAINS_MISSING)
        self._gains.finish_round()
        return self._gains.gains.copy()

    def gradients(self) -> dict[str, Array]:
        """See ``UpdateEngine.gradients``. The gradients of frozen layers are stale."""
        deformation = self._deformation
        tables = {f"cluster {layer}": g.copy() for layer, g in enumerate(deformation.cluster_gradients)}
        tables["deltas"] = deformation.delta_gradients.copy()
        if self._colour_table is not None:
            tables["colours"] = self._colour_table.gradients()
        if self._gloss is not None:
            tables["gloss"], tables["environment"] = (gradient.copy() for gradient in self._gloss.gradients)
        return tables

    def _forward(self) -> None:
        """Recomputes the deformed Gaussians if the tables have changed."""
        if not self._deformed:
            self._deformation.forward()
            self._deformed = True

    def _with_looks(self, state: Gaussians) -> Gaussians:
        """Returns a state with the colours, gloss and environment learned so far, without copying them."""
        if self._gloss is None:
            return state.replace(colours=self._colours)
        return state.replace(colours=self._colours, gloss=self._gloss.gloss, environment=self._gloss.environment)
