"""One contract for all engines: what ``UpdateEngine`` promises, and the reference's values and gradients."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable
from contextlib import suppress

import numpy as np
import pytest
from engine_cases import (
    CLUSTERS,
    EFFECTS,
    TOGETHER,
    Case,
    apart,
    assert_repeated,
    case,
    gaussians,
    loaded,
    random_tables,
    rig,
    step,
)

from scas4d_core.engines.cpu.engine import CpuEngine
from scas4d_core.engines.engine import KEPT_PICTURES, EngineError, Probe, Tables, UpdateEngine
from scas4d_core.engines.freedom import Freedom
from scas4d_core.engines.plan import ColourPlan
from scas4d_core.engines.torch.engine import TorchEngine
from scas4d_core.gaussians import Gaussians
from scas4d_core.settings import SceneSettings, UpdateSettings
from scas4d_core.update.frame_update import FrameUpdate
from scas4d_core.update.parts import Attempt, PlanBuilder, UpdatePart
from scas4d_core.update.result import AttemptOptions
from scas4d_core.update.schedule import Stopping
from scas4d_core.update.view_factory import ViewFactory

ENGINES: dict[str, Callable[[], UpdateEngine]] = {"cpu": CpuEngine, "torch": TorchEngine}
if importlib.util.find_spec("warp") is not None:
    from scas4d_core.engines.warp.engine import WarpEngine

    ENGINES["warp"] = lambda: WarpEngine(os.environ.get("SCAS4D_WARP_DEVICE", "cpu"))
TESTED = {name: made for name, made in ENGINES.items() if name != "torch"}
"""The engines that are compared with the reference; a new one is a line of ``ENGINES``."""
PLANS = {**EFFECTS, "all together": TOGETHER}
TOLERANCE = 1e-4
"""Relative to the norm: float32 against float64, of each stage's values and gradients."""
AFTER_A_STEP = 2e-3
"""Likewise after a step of Adam: it divides by gradients, so that those near 0 step either way."""


@pytest.fixture(params=ENGINES)
def engine(request) -> UpdateEngine:
    return ENGINES[request.param]()


# Values and gradients against the reference.


@pytest.mark.parametrize("tested", TESTED)
@pytest.mark.parametrize("effect", PLANS)
def test_an_iteration_has_the_values_and_gradients_of_the_reference(effect: str, tested: str) -> None:
    scene = case(**PLANS[effect])
    mine, true = loaded(TESTED[tested](), scene), loaded(TorchEngine(), scene)
    for engine in (mine, true):
        engine.iterate([0], step(rigidity=scene.plan.rigidity))
    gradients, expected = mine.gradients(), true.gradients()
    assert mine.log().losses == pytest.approx(true.log().losses, rel=TOLERANCE)
    assert set(gradients) == set(expected) == learnt_tables(scene)
    for name in gradients:
        rows = scene.rows if name == "colours" and not scene.plan.colours.static else slice(None)
        assert np.linalg.norm(expected[name][rows]) > 0, name
        assert apart(gradients[name][rows], expected[name][rows]) < TOLERANCE, name


def learnt_tables(scene: Case) -> set[str]:
    """Names of the tables that a plan learns."""
    names = {"cluster 0", "cluster 1", "deltas"}
    if scene.plan.colours is not None:
        names |= {"colours"}
    if scene.plan.gloss:
        names |= {"gloss", "environment"}
    return names


@pytest.mark.parametrize("tested", TESTED)
@pytest.mark.parametrize("effect", PLANS)
def test_states_and_probes_are_those_of_the_reference(effect: str, tested: str) -> None:
    scene = case(**PLANS[effect])
    mine, true = loaded(TESTED[tested](), scene), loaded(TorchEngine(), scene)
    for moved in (False, True):
        errors = [
            engine.probe(Probe(range(len(scene.probes)), moved=moved, learnt=False))[0] for engine in (mine, true)
        ]
        assert errors[0] == pytest.approx(errors[1], rel=TOLERANCE)
    close(mine.state(learnt=False), true.state(learnt=False), TOLERANCE)
    for engine in (mine, true):
        engine.iterate([0], step())
    errors = [engine.probe(Probe(range(len(scene.probes)), moved=True, learnt=True))[0] for engine in (mine, true)]
    assert errors[0] == pytest.approx(errors[1], rel=AFTER_A_STEP)
    close(mine.state(learnt=True), true.state(learnt=True), AFTER_A_STEP)


def close(mine: Gaussians, true: Gaussians, tolerance: float) -> None:
    for name, array in true.arrays().items():
        if array.dtype.kind == "f":
            assert apart(mine.arrays()[name], array) < tolerance, name


@pytest.mark.parametrize("tested", TESTED)
def test_the_mean_over_views_is_that_of_the_reference(tested: str) -> None:
    scene = case(**TOGETHER)
    mine, true = loaded(TESTED[tested](), scene), loaded(TorchEngine(), scene)
    for engine in (mine, true):
        engine.iterate([3, 0, 2], step())
    gradients, expected = mine.gradients(), true.gradients()
    for name in gradients:
        assert apart(gradients[name], expected[name]) < TOLERANCE, name
    assert [row.view for row in mine.log().rendered] == [row.view for row in true.log().rendered] == [3, 0, 2]


@pytest.mark.parametrize("tested", TESTED)
@pytest.mark.parametrize("effect", PLANS)
def test_an_update_of_eight_iterations_ends_where_the_reference_does(effect: str, tested: str) -> None:
    scene = case(**PLANS[effect])
    ends = [updated(scene, engine) for engine in (TESTED[tested](), TorchEngine())]
    (mine, losses, gains), (true, expected, true_gains) = ends
    assert losses == pytest.approx(expected, rel=0.01)
    assert np.median(np.linalg.norm(mine.means - true.means, axis=1)[scene.rows]) < 1e-3
    assert apart(mine.colours, true.colours) < 0.01
    if scene.plan.camera_gains:
        assert np.abs(gains - true_gains).max() < 0.002
        assert np.ptp(true_gains, axis=0).min() > 0.05  # they follow
    if scene.plan.gloss:
        assert apart(mine.gloss, true.gloss) < 0.01
        assert apart(mine.environment, true.environment) < 0.02
        assert apart(true.environment, scene.previous.environment) > 0.01  # it is learnt


class GainsOfOne(UpdatePart):
    """Follows gains that start at 1, and remembers their end."""

    def begin(self, attempt: Attempt) -> None:
        attempt.gains = np.ones((len(attempt.views), 3), np.float32)

    def end(self, attempt: Attempt, state):  # type: ignore[no-untyped-def]
        self.last = attempt.engine.gains()
        return state


def updated(scene: Case, engine: UpdateEngine):  # type: ignore[no-untyped-def]
    """Θ_t, losses and gains after eight iterations of ``FrameUpdate``, the product's loop."""
    settings = UpdateSettings(clusters=CLUSTERS)
    builder = PlanBuilder(SceneSettings(), settings, ViewFactory(rig()), scene.structure.hierarchy, scene.previous)
    gains = GainsOfOne()
    builder.plan, builder.parts = scene.plan, [gains] if scene.plan.camera_gains else []
    updater = FrameUpdate(engine, builder, scene.structure.neighbours)
    options = AttemptOptions(stopping=Stopping(8))
    result = updater.run(scene.previous, scene.views, None, 1 / 30, seed=3, options=options)
    return result.gaussians, result.trace.losses, getattr(gains, "last", None)


# What every engine promises.


def test_no_motion_leaves_the_state_as_it_is(engine: UpdateEngine) -> None:
    scene = case()
    loaded(engine, scene, Tables.identity(scene.structure.hierarchy))
    state = engine.state(learnt=True)
    for name in ("means", "factors", "rotations", "colours", "opacities", "foreground"):
        assert np.allclose(getattr(state, name), getattr(scene.previous, name), atol=1e-6), name


def test_tables_come_back_as_they_were_set(engine: UpdateEngine) -> None:
    scene = case()
    tables = random_tables(scene)
    loaded(engine, scene, tables)
    back = engine.tables()
    assert all(map(np.array_equal, back.clusters, tables.clusters))
    assert np.array_equal(back.deltas, tables.deltas)
    with suppress(ValueError):  # the engine has its own, or has made these read-only
        tables.deltas[:] = 7
    assert np.array_equal(engine.tables().deltas, back.deltas)


def test_tables_after_a_state_are_those_of_the_last_iteration(engine: UpdateEngine) -> None:
    scene = case()
    loaded(engine, scene)
    seen = []
    for view in (0, 1):
        engine.iterate([view], step())
        engine.state(learnt=True)  # an engine may read the tables with it
        seen.append(engine.tables())
    engine.iterate([2], step())
    seen.append(engine.tables())
    assert len({tables.deltas.tobytes() for tables in seen}) == 3
    engine.set_tables(seen[0])
    assert np.array_equal(engine.tables().deltas, seen[0].deltas)


def test_a_probe_of_the_state_before_does_not_depend_on_the_tables(engine: UpdateEngine) -> None:
    scene = case()
    loaded(engine, scene)
    before = engine.probe(Probe([0, 2], moved=False, learnt=False))[0]
    engine.set_tables(random_tables(scene, 0.05, seed=9))
    assert_repeated(engine.probe(Probe([0, 2], moved=False, learnt=False))[0], before)
    assert_repeated(engine.probe(Probe([2], moved=False, learnt=False))[0], before[1:])
    assert engine.probe(Probe([0, 2], moved=True, learnt=False))[0] != before


def test_probes_together_have_the_errors_of_each_alone(engine: UpdateEngine) -> None:
    loaded(engine, case())
    engine.iterate([0], step())
    probes = [Probe([0, 2], moved=False, learnt=False), Probe([1], moved=True, learnt=False)]
    probes += [Probe(range(5), moved=True, learnt=True), Probe([0], moved=False, learnt=False)]
    alone = [engine.probe(probe)[0] for probe in probes]
    together = engine.probe(*probes, state_next=True)
    assert [len(each) for each in together] == [2, 1, 5, 1]
    for one, all_at_once in zip(alone, together, strict=True):
        assert_repeated(all_at_once, one)
    state = engine.state(learnt=True)
    again = engine.state(learnt=True)
    np.testing.assert_array_equal(state.means, again.means)
    np.testing.assert_array_equal(state.colours, again.colours)


def test_iterations_lower_the_error_of_the_probes(engine: UpdateEngine) -> None:
    scene = case(**EFFECTS["moving colours"])
    loaded(engine, scene, Tables.identity(scene.structure.hierarchy), layers=((0.01, 0.005, 0.002),) * 2)
    before = np.mean(engine.probe(Probe(range(5), moved=True, learnt=True))[0])
    for iteration in range(20):
        engine.iterate([iteration % 5], step(sample=iteration % 2, layers=(1.0, 0.3), own=0.0))
    assert np.mean(engine.probe(Probe(range(5), moved=True, learnt=True))[0]) < 0.9 * before


def test_what_has_no_rate_or_no_factor_stays(engine: UpdateEngine) -> None:
    scene = case(**EFFECTS["standing colours"])
    tables = random_tables(scene)
    loaded(engine, scene, tables, layers=((0.02, 0.0, 0.005), (0.02, 0.02, 0.0)), scale=0.0, static_colour=0.0)
    for _ in range(3):
        engine.iterate([1], step(layers=(1.0, 0.0), frozen=0))
    after, state = engine.tables(), engine.state(learnt=True)
    coarse, fine, own = after.clusters[0], after.clusters[1], after.deltas
    assert np.array_equal(coarse[:, 3:6], tables.clusters[0][:, 3:6])
    assert not np.array_equal(coarse[:, :3], tables.clusters[0][:, :3])
    assert np.array_equal(fine, tables.clusters[1])
    assert np.array_equal(own[:, 6:], tables.deltas[:, 6:])
    assert not np.array_equal(own[:, :3], tables.deltas[:, :3])
    static = np.setdiff1d(np.arange(len(scene.previous)), scene.rows)
    assert np.array_equal(state.colours[static], scene.previous.colours[static])
    assert not np.array_equal(state.colours[scene.rows], scene.previous.colours[scene.rows])


def test_layers_that_rest_do_not_move(engine: UpdateEngine) -> None:
    scene = case()
    tables = random_tables(scene)
    loaded(engine, scene, tables)
    engine.iterate([0], step(frozen=1, layers=(0.0, 1.0)))
    engine.iterate([1], step(frozen=1, layers=(0.0, 1.0)))
    after = engine.tables()
    assert np.array_equal(after.clusters[0], tables.clusters[0])
    assert not np.array_equal(after.clusters[1], tables.clusters[1])


@pytest.mark.parametrize("probed", [False, True])
def test_the_log_has_every_rendering_and_the_last_pictures(engine: UpdateEngine, probed: bool) -> None:
    scene = case()
    loaded(engine, scene)
    for iteration in range(4):
        engine.iterate([iteration, 4], step(keep_pictures=iteration >= 2))
    if probed:
        engine.probe(Probe([0], moved=True, learnt=True))  # an engine may read the log with it
    log = engine.log()
    assert len(log.losses) == 4
    assert [row.view for row in log.rendered] == [0, 4, 1, 4, 2, 4, 3, 4]
    assert all(10 < row.psnr < 60 and np.abs(row.colour_shift).max() < 0.2 for row in log.rendered)
    assert list(log.pictures) == [2, 3, 4]
    assert len(log.pictures) <= KEPT_PICTURES
    assert log.pictures[3].planes.shape == (5, 40, 48)
    engine.begin(scene.start())
    assert engine.log().losses == []


def test_gaussians_that_are_not_finite_are_held_back(engine: UpdateEngine) -> None:
    state = gaussians()
    means = state.means.copy()
    means[[7, 100]] = np.nan
    scene = case(state.replace(means=means), **{**TOGETHER, "gloss": False})
    tables = random_tables(scene)
    loaded(engine, scene, tables)
    for view in range(3):
        engine.iterate([view], step())
    assert np.isfinite(engine.log().losses).all()
    after = engine.state(learnt=False)
    assert np.isnan(after.means[[7, 100]]).all()
    assert np.array_equal(after.factors[[7, 100]], state.factors[[7, 100]])
    others = np.setdiff1d(np.arange(len(state)), [7, 100])
    assert np.isfinite(after.means[others]).all()


def test_views_that_are_left_out_keep_their_gains(engine: UpdateEngine) -> None:
    scene = case(**EFFECTS["camera gains"])
    loaded(engine, scene)
    engine.leave_out([4])
    for view in (0, 1, 2, 3, 0):
        engine.iterate([view], step())
    exposures, gains = engine.exposures(), engine.gains()
    assert np.array_equal(exposures["c4"][:3], np.float32([[1, 0]] * 3))
    assert np.abs(exposures["c0"][:3, 0] - 1).min() > 0.001
    assert np.array_equal(gains[4], np.ones(3, np.float32))


def test_another_attempt_starts_afresh(engine: UpdateEngine) -> None:
    scene = case(**TOGETHER)
    firsts = []
    for _ in range(2):
        loaded(engine, scene)
        engine.iterate([0], step())
        engine.iterate([2], step(sample=1))
        firsts.append((engine.log().losses, engine.tables().deltas, engine.exposures()["c1"]))
    for first, second in zip(*firsts, strict=True):
        assert_repeated(first, second)


def test_gains_that_were_not_given_are_refused(engine: UpdateEngine) -> None:
    loaded(engine, case())
    with pytest.raises(ValueError, match="begin was called without gains"):
        engine.gains()


def test_an_engine_that_cannot_do_what_a_plan_asks_says_so_by_name() -> None:
    class Colourless(CpuEngine):
        name = "colourless"

        def bind(self, plan, structure) -> None:  # type: ignore[no-untyped-def]
            if plan.colours is not None:
                raise EngineError(self.name, ["colours"])
            super().bind(plan, structure)

    scene = case(colours=ColourPlan(moving=True))
    builder = PlanBuilder(
        SceneSettings(), UpdateSettings(), ViewFactory(rig()), scene.structure.hierarchy, scene.previous
    )
    builder.plan = scene.plan
    with pytest.raises(EngineError, match="engine colourless does not support: colours; disable the effect") as error:
        FrameUpdate(Colourless(), builder, None)
    assert error.value.asked == ("colours",)


def test_nothing_free_means_nothing_moves(engine: UpdateEngine) -> None:
    scene = case(freedom=Freedom(), **EFFECTS["moving colours"])
    still = Tables.identity(scene.structure.hierarchy)
    loaded(engine, scene, still, layers=((0.0, 0.0, 0.0),) * 2, position=0.0, rotation=0.0, scale=0.0)
    engine.iterate([0], step())
    assert np.allclose(engine.state(learnt=False).means, scene.previous.means, atol=1e-6)
