"""Wherever a glossy state is compared with pictures, it is compared as the cameras see it."""

from __future__ import annotations

import numpy as np
import pytest
from effect_cases.glossy_ball import COUNT, frame, rig, sphere

from scas4d_core.effects.evidence import FitTime
from scas4d_core.effects.presence.newborn_fit import refine_newborns
from scas4d_core.effects.presence.novelty import measure_novelty
from scas4d_core.effects.switches import register_effects
from scas4d_core.engines.cpu.engine import CpuEngine
from scas4d_core.engines.cpu.renderer import CpuRenderer
from scas4d_core.engines.engine import Tables
from scas4d_core.engines.views import TrainingView
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians
from scas4d_core.preparation import SMALLEST_CLUSTER
from scas4d_core.robust.checks import measure_light_gain
from scas4d_core.robust.relocation import find_jump, shift_moving
from scas4d_core.robust.solve_frame import FrameSolver
from scas4d_core.settings import SceneSettings, UpdateSettings
from scas4d_core.structure.hierarchy import build_hierarchy
from scas4d_core.update.best_state import BestState, ProbeViews, mean_error
from scas4d_core.update.frame_update import FrameUpdate
from scas4d_core.update.parts import PlanBuilder
from scas4d_core.update.result import AttemptOptions, UpdateResult
from scas4d_core.update.schedule import Stopping
from scas4d_core.update.view_factory import ViewFactory

BALL = sphere()
PLAIN = BALL.replace(gloss=None, environment=None)
FACTORY = ViewFactory(rig())
RENDERER = CpuRenderer((0.0, 0.0, 0.0))
SETTINGS = UpdateSettings(iterations=24, clusters=(2, 12))
CLOSE = 0.7
"""Of the error without the gloss, that is left with it: probe views are coarser than the pictures."""


def views(truth: Gaussians = BALL) -> list[TrainingView]:
    return FACTORY.views(frame(truth, 1), {}, use_masks=False)


def updater(before: Gaussians, engine: CpuEngine, clusters: tuple[int, ...] = (2, 12)) -> FrameUpdate:
    hierarchy = build_hierarchy(before.means, before.moving, clusters, SMALLEST_CLUSTER)
    built = PlanBuilder(SceneSettings(), SETTINGS, FACTORY, hierarchy, before)
    return FrameUpdate(engine, register_effects(built, ["moving_colour", "direction"]), None)


def run(before: Gaussians) -> UpdateResult:
    return updater(before, CpuEngine()).run(
        before, views(), None, 1.0, seed=1, options=AttemptOptions(stopping=Stopping(24), compare=True)
    )


def probed(state: Gaussians) -> float:
    """Mean error of a state in the probe views."""
    engine = CpuEngine()
    updater(state, engine)
    found = ProbeViews(FACTORY, engine, views())
    engine.load_views(views(), found.views)
    engine.load_state(state)
    return mean(found.start_errors(warm=False)[0])


def mean(errors: dict[str, float]) -> float:
    return mean_error(errors, list(errors))


def test_the_candidates_of_an_update_have_the_gloss_that_they_are_committed_with() -> None:
    plain = probed(PLAIN)
    known = run(BALL).trace.errors
    assert mean(known[Candidate.PREVIOUS]) < CLOSE * plain
    assert BALL.environment is not None
    learnt = run(BALL.replace(environment=0 * BALL.environment))
    state, errors = learnt.gaussians, learnt.trace.errors[Candidate.END]
    assert learnt.trace.kept is Candidate.END
    assert state.environment is not None
    assert state.environment.any()
    # The gloss of the committed state is turned with its neighbourhood, that of the candidate with each Gaussian.
    assert mean(errors) == pytest.approx(probed(state), rel=0.02)
    assert mean(errors) < 0.98 * probed(state.replace(gloss=None))


def test_a_candidate_is_seen_with_its_normals_turned() -> None:
    engine = CpuEngine()
    hierarchy = updater(BALL, engine, (2,)).hierarchy
    probes = ProbeViews(FACTORY, engine, views())
    engine.load_views(views(), probes.views)
    engine.load_state(BALL)
    best = BestState(probes, engine, hierarchy, None, 1.0, 0.5)
    best.start()
    still = best.error()
    tables = Tables.identity(hierarchy)
    tables.clusters[0][:, :3] = [0.0, 0.4, 0.0]
    engine.set_tables(tables)
    turned = best.error()
    assert turned > still
    moved = engine.state(learnt=False)
    stays = probed(BALL.replace(means=moved.means, factors=moved.factors))
    assert abs(turned - stays) > 1e-3 * stays


def test_cameras_that_are_looked_at_again_see_the_gloss() -> None:
    solver = FrameSolver(None, FACTORY, RENDERER, SETTINGS)  # type: ignore[arg-type]
    seen, plain = solver._psnr_by_camera(views(), BALL), solver._psnr_by_camera(views(), PLAIN)
    assert min(seen.values()) > max(plain.values())
    assert min(seen.values()) > 40


def test_the_light_is_not_brighter_by_what_is_mirrored() -> None:
    assert measure_light_gain(RENDERER, BALL, views()) == pytest.approx(1.0, abs=0.005)
    assert measure_light_gain(RENDERER, PLAIN, views()) != pytest.approx(1.0, abs=0.02)


def test_what_stands_is_not_taken_for_what_jumped_by_its_gloss() -> None:
    """A dull thing jumps above a glossy one that stands, whose highlights are no pixels that differ."""
    thing = Gaussians.of_points(0.1 * PLAIN.means[::10] + np.float32([0, -0.32, 0]), 0.02, [0.2, 0.9, 0.2])
    state = BALL.replace(foreground=np.zeros(COUNT, np.float32)).concatenate(thing)
    way = np.array([0.1, 0.0, 0.05])
    jumped = find_jump(state, views(shift_moving(state, way)), RENDERER, rig())
    assert jumped is not None
    np.testing.assert_allclose(jumped, way, atol=0.02)


def test_a_glossy_thing_has_nothing_new() -> None:
    said = measure_novelty(BALL.replace(foreground=np.zeros(COUNT, np.float32)), BALL.colours, views(), rig(), RENDERER)
    assert sum(int(one.new.sum()) for one in said) == 0
    assert max(float(one.error.max()) for one in said) < 3e-3


def test_what_is_glossy_and_came_back_is_not_settled() -> None:
    grown = BALL.concatenate(Gaussians.of_points(BALL.means[:5] + np.float32(0.02), 0.01))
    rng = np.random.default_rng(0)
    rows = np.array([3, 4, COUNT + 1])
    after = refine_newborns(grown, rows, views(), rig(), RENDERER, rng, FitTime())
    assert np.array_equal(after.means[:COUNT], grown.means[:COUNT])
    assert not np.array_equal(after.means[COUNT + 1], grown.means[COUNT + 1])
    assert refine_newborns(grown, rows[:2], views(), rig(), RENDERER, rng, FitTime()) is grown
