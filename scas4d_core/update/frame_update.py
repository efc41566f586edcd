"""Update of one frame: from Θ_{t−1} and the images of frame t to Θ_t (paper, algorithm 1).

The loop is ``FrameUpdate.run``. An iteration is one call to the engine (``engines.engine.UpdateEngine.iterate``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import cos, pi

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.engine import KEPT_PICTURES, REPORT, AttemptStart, StepScalars, UpdateEngine
from scas4d_core.engines.plan import Structure
from scas4d_core.engines.views import TrainingView
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians
from scas4d_core.structure.hierarchy import Hierarchy
from scas4d_core.structure.neighbours import Neighbours
from scas4d_core.update.best_state import BestState, ProbeViews
from scas4d_core.update.matched_start import FAR, GAIN, matched_start
from scas4d_core.update.parts import NOTHING, Arrays, Attempt, PlanBuilder
from scas4d_core.update.rates import Rates, step_factors
from scas4d_core.update.result import AS_CONFIGURED, AttemptOptions, Gate, Stopwatch, UpdateResult, UpdateTrace
from scas4d_core.update.schedule import Stopping, ViewPlan, plan_samples
from scas4d_core.update.warm_start import Motion, predicted

Array = NDArray[np.float32]

SMOOTH_GLOSS_EVERY = 10
"""Number of iterations between two passes that smooth gloss changes over neighbours."""
GLOSS_END = 0.1
"""Fraction to which the gloss learning rates decay by the end of an update."""


class FrameUpdate:
    """Updates the frames of a scene for one hierarchy, on one engine.

    Args:
        engine: engine that computes the updates. The constructor binds it to the plan.
        built: plan and parts of the active effects.
        neighbours: neighbours of the moving Gaussians, or None if no term needs them.

    Attributes:
        settings: settings of the updates.
        plan: plan of the updates.
        hierarchy: hierarchy of the moving Gaussians.

    Raises:
        EngineError: if the engine does not support the plan.
    """

    def __init__(self, engine: UpdateEngine, built: PlanBuilder, neighbours: Neighbours | None) -> None:
        self.settings, self.hierarchy = built.update, built.hierarchy
        self._engine, self.plan, self._parts, self._factory = engine, built.plan, built.parts, built.factory
        freedom = self.plan.freedom
        free = freedom.cluster_rotation and freedom.cluster_translation and freedom.prediction
        self._matches = self.settings.match_patches and free
        rates = Rates.of(self.settings, len(self.hierarchy.sizes), self._factory.rig.reach)
        self._rates = rates.restricted_to(freedom)
        engine.bind(self.plan, structure_of(self.hierarchy, neighbours, built.first))

    def run(
        self,
        previous: Gaussians,
        views: Sequence[TrainingView],
        motion: Motion | None,
        seconds: float,
        seed: int,
        options: AttemptOptions = AS_CONFIGURED,
        carried: Mapping[str, Arrays] = NOTHING,
    ) -> UpdateResult:
        """Finds the deformation D_t, applies it to Θ_{t−1}, and returns the result.

        Args:
            previous: previous state Θ_{t−1}.
            views: training views of frame t.
            motion: motion of the previous update, or None.
            seconds: time between the frames, in seconds.
            seed: seed for the order of views and the sampled neighbours.
            options: options of this attempt.
            carried: arrays carried over by the effects, keyed by effect name.
        """
        settings, engine = self.settings, self._engine
        motion = predicted(motion, self.plan.freedom)
        stopping = options.stopping or Stopping(settings.iterations)
        rng = np.random.default_rng([settings.seed, seed])
        watch, trace = Stopwatch(), UpdateTrace()
        order = ViewPlan(len(views), settings.views, stopping.most, rng)
        samples = plan_samples(len(self.hierarchy.rows), rng)
        probes = ProbeViews(self._factory, engine, views if options.compare else [])
        engine.load_views(views, probes.views)
        engine.load_state(previous)
        best = BestState(probes, engine, self.hierarchy, motion, seconds, settings.momentum)
        tables = best.start(options.step)
        if self._matches and options.match_patches and best.is_far(options.reference_errors, FAR):
            expected = engine.state(learnt=False)
            matched = matched_start(tables, previous, expected, self.hierarchy, views, self._factory, engine.renderer)
            tables = best.start_from(tables, matched, GAIN)
        rates = self._rates_of(options, motion, best)
        attempt = Attempt(engine, engine.renderer, previous, views, rates, tables, dict(carried))
        for part in self._parts:
            part.begin(attempt)
        engine.set_tables(attempt.tables)
        engine.begin(self._start(rates, samples, attempt.gains, watch))
        if not self.plan.disables_skip and best.can_skip(options.skip_below, options.confirm_skip):
            stopping = Stopping(0)
        watch.lap("start")
        rendered: set[int] = set()
        iteration = planned_before = 0
        while iteration < (planned := stopping.planned(iteration)):
            engine.wait(iteration)
            chosen = order.take()
            step = self._step(rates, iteration, planned, planned_before or planned, len(samples))
            engine.iterate(chosen, step)  # deformation, rendering, loss, backward pass, Adam
            iteration, planned_before = iteration + 1, planned
            trace.iteration_ends.append(watch.total)
            watch.lap(REPORT)
            all_seen = len(rendered) == len(views)
            rendered.update(chosen)
            if options.gate is not None and not all_seen and len(rendered) == len(views):
                self._exclude_outliers(options.gate, attempt, order, trace)
                watch.lap("judge")
            if stopping.needs_error(iteration):
                stopping.record_error(iteration, best.error())
                watch.lap("looks")
        trace.kept = attempt.kept = best.end(iteration, trace.left_out)
        trace.load_log(engine.log(), views)  # after the errors of `end`: a GPU engine downloads its log with them
        trace.planned, trace.errors = stopping.planned_so_far, best.errors
        trace.whole = best.whole
        watch.lap("end")
        state = self._finish(attempt)
        after = Motion.of(engine.tables(), self.hierarchy, best.seconds, own=settings.momentum > 0)
        trace.guards = engine.log().guards
        watch.lap("commit")
        trace.seconds = watch.seconds
        return UpdateResult(state, after, trace, carried=attempt.carried, views=self._exposed(views))

    def _exclude_outliers(self, gate: Gate, attempt: Attempt, order: ViewPlan, trace: UpdateTrace) -> None:
        """Excludes cameras that do not fit from the rest of an attempt, once every camera has been rendered."""
        trace.load_log(self._engine.log(), attempt.views)

        def current() -> tuple[Gaussians, Sequence[TrainingView]]:
            return self._engine.state(learnt=True), self._exposed(attempt.views)

        trace.left_out.update(gate(trace.first, current))
        excluded = [index for index, view in enumerate(attempt.views) if view.name in trace.left_out]
        order.leave_out(excluded)
        self._engine.leave_out(excluded)
        attempt.views = [view for view in attempt.views if view.name not in trace.left_out]

    def _finish(self, attempt: Attempt) -> Gaussians:
        """Returns the state of the selected candidate, modified by each effect."""
        state = attempt.previous
        if attempt.kept is not Candidate.PREVIOUS:
            state = self._engine.state(learnt=attempt.kept is Candidate.END)
        attempt.views = self._exposed(attempt.views)
        for part in self._parts:
            state = part.end(attempt, state)
        return state

    def _rates_of(self, options: AttemptOptions, motion: Motion | None, best: BestState) -> Rates:
        """Returns the rates of an attempt, from its options and the quality of the previous motion."""
        rates = self._rates.for_attempt(options.rates, options.rigid, options.freeze_colours)
        if motion is None:
            return rates.for_cold_start(
                options.layer_rate_factor * self.settings.cold_start_rates, options.several_orders
            )
        return rates.for_warm_start(best.unexplained(options.reference_errors))

    def _start(
        self, rates: Rates, samples: Sequence[NDArray[np.int64]], gains: Array | None, watch: Stopwatch
    ) -> AttemptStart:
        moving, static = rates.colour_rates(self.plan.colours)
        return AttemptStart(
            layers=rates.layers, position=rates.position, rotation=rates.rotation, scale=rates.scale,
            colour=moving, static_colour=static, beta1=rates.beta1, beta2=rates.beta2,
            samples=samples, gains=gains, lap=watch.lap,
        )  # fmt: skip

    def _step(self, rates: Rates, iteration: int, planned: int, planned_before: int, samples: int) -> StepScalars:
        """Returns the scalars of an iteration.

        Args:
            rates: learning rates of the attempt.
            iteration: index of the iteration.
            planned: total number of iterations, as currently planned.
            planned_before: total number of iterations, as planned at the previous iteration.
            samples: number of neighbour samples.
        """
        rigidity = self.plan.rigidity
        if self.plan.rigidity_fades:  # at the end of an update, positions are more reliable than rotations
            rigidity *= 0.5 * (1 + cos(pi * min(1.0, iteration / planned_before)))
        factors = step_factors(rates, iteration, planned)
        return StepScalars(
            frozen=factors.frozen,
            layers=factors.layers,
            own=factors.own,
            colour=factors.colour,
            gloss=1 - (1 - GLOSS_END) * iteration / planned,
            smooth_gloss=(iteration + 1) % SMOOTH_GLOSS_EVERY == 0,
            rigidity=rigidity,
            sample=iteration % samples,
            keep_pictures=planned - iteration - 1 < KEPT_PICTURES,
        )

    def _exposed(self, views: Sequence[TrainingView]) -> Sequence[TrainingView]:
        """Returns the views with the current exposures of their cameras."""
        if not self.plan.camera_gains:
            return views
        exposures = self._engine.exposures()
        return [replace(view, exposure=exposures[view.name]) for view in views]


def structure_of(hierarchy: Hierarchy, neighbours: Neighbours | None, first: Gaussians) -> Structure:
    """Returns the structure that an update deforms, with the positions and axis lengths of frame 0.

    Args:
        hierarchy: hierarchy of the moving Gaussians.
        neighbours: neighbours of the moving Gaussians, or None.
        first: root Gaussians: Θ_0 plus all Gaussians added since.
    """
    lengths: Array = np.sqrt(np.square(first.factors).sum(axis=1))
    return Structure(hierarchy, neighbours, first.means, lengths)
