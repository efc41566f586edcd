"""How the Warp engine runs an attempt: launches and waits, repeated attempts, frozen layers and kept pictures."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

pytest.importorskip("warp", reason="NVIDIA Warp is not installed: pip install warp-lang")

import warp as wp
from engine_cases import CLUSTERS, EFFECTS, TOGETHER, Case, apart, assert_repeated, case, loaded, rig, step
from warp_cases import DEVICE, Waits

from scas4d_core.engines.cpu.engine import CpuEngine
from scas4d_core.engines.engine import Probe, StepScalars, Tables
from scas4d_core.engines.warp import engine as module
from scas4d_core.engines.warp.engine import WarpEngine
from scas4d_core.engines.warp.graphs import Graphs
from scas4d_core.settings import SceneSettings, UpdateSettings
from scas4d_core.update.frame_update import FrameUpdate
from scas4d_core.update.parts import PlanBuilder
from scas4d_core.update.result import AttemptOptions
from scas4d_core.update.schedule import Stopping
from scas4d_core.update.view_factory import ViewFactory

CLOSE = 2e-3
"""Relative to the norm: two float32 engines after a few steps of Adam."""


RATES = ((0.02, 0.02, 0.005),) * 3
"""Learning rates of three layers."""


def launches(monkeypatch: pytest.MonkeyPatch, act: Callable[[], None]) -> int:
    """Returns the number of kernels that an action launches."""
    count, launch = [0], wp.launch

    def counted(*given: object, **named: object) -> object:
        count[0] += 1
        return launch(*given, **named)

    monkeypatch.setattr(wp, "launch", counted)
    act()
    monkeypatch.setattr(wp, "launch", launch)
    return count[0]


def three_layers(**plan: object) -> Case:
    """A scene with the cascade of the default settings, three layers."""
    return case(clusters=(2, 4, 8), **plan)


def test_an_iteration_needs_at_most_twenty_launches(monkeypatch) -> None:
    scene = three_layers(**{**TOGETHER, "gloss": False, "camera_gains": False})
    engine = loaded(WarpEngine(DEVICE), scene, layers=RATES)
    once = step(layers=(1.0,) * 3)
    assert launches(monkeypatch, lambda: engine.iterate([0], once)) <= 20
    engine.iterate([0], step(frozen=2, layers=(0.0, 0.0, 1.0)))
    later = launches(monkeypatch, lambda: engine.iterate([0], step(frozen=2, layers=(0.0, 0.0, 1.0))))
    assert later <= 16  # two layers are neither evaluated nor differentiated


def test_the_host_does_not_wait_within_iterations() -> None:
    waits = {count: waits_of_a_frame(count) for count in (8, 40)}
    assert waits[40] == waits[8] <= 8


def waits_of_a_frame(iterations: int) -> int:
    """Returns how often the host waits for the device in an update."""
    scene, engine = case(**TOGETHER), WarpEngine(DEVICE)
    settings = UpdateSettings(clusters=CLUSTERS)
    builder = PlanBuilder(SceneSettings(), settings, ViewFactory(rig()), scene.structure.hierarchy, scene.previous)
    builder.plan, builder.parts = scene.plan, []
    updater = FrameUpdate(engine, builder, scene.structure.neighbours)
    options = AttemptOptions(stopping=Stopping(iterations))
    updater.run(scene.previous, scene.views, None, 1 / 30, seed=3, options=options)
    return engine.downloads.waits


def test_memory_that_is_full_for_a_while_leaves_no_trace(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = three_layers(**TOGETHER)
    engine, failures = WarpEngine(DEVICE), 0
    engine.bind(scene.plan, scene.structure)
    while failures < 100:
        with monkeypatch.context() as limited:
            limit_allocations(limited, failures)
            try:
                engine.load_views(scene.views, scene.probes)
            except RuntimeError:
                failures += 1
            else:
                break
    assert failures > 10
    records = []
    for each in (engine, WarpEngine(DEVICE)):
        if each is not engine:
            each.bind(scene.plan, scene.structure)
            each.load_views(scene.views, scene.probes)
        each.load_state(scene.previous)
        each.set_tables(Tables.identity(scene.structure.hierarchy))
        each.begin(scene.start(layers=RATES))
        for views, scalars in STEPS:
            each.iterate(views, scalars)
        (errors,) = each.probe(Probe(range(len(scene.probes)), moved=True, learnt=True))
        records.append(each.log().losses + errors)
    assert records[0] == pytest.approx(records[1], rel=1e-5)


def limit_allocations(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """Makes all but the next ``count`` calls of ``wp.zeros`` fail, as they do if memory is full."""
    zeros, left = wp.zeros, [count]

    def limited(*given: object, **named: object) -> wp.array:
        if not left[0]:
            raise RuntimeError("Failed to allocate 1 bytes on device 'cuda:0'")
        left[0] -= 1
        return zeros(*given, **named)

    monkeypatch.setattr(wp, "zeros", limited)


FREE, FIRST_FROZEN, TWO_FROZEN = (1.0, 1.0, 1.0), (0.0, 1.0, 1.0), (0.0, 0.0, 1.0)
STEPS: list[tuple[list[int], StepScalars]] = [
    ([0], step(layers=FREE)),
    ([1, 3], step(layers=FREE, sample=1)),
    ([2], step(frozen=1, layers=FIRST_FROZEN, smooth_gloss=True)),
    ([4], step(frozen=1, layers=FIRST_FROZEN)),
    ([0, 2], step(frozen=2, layers=TWO_FROZEN, keep_pictures=True)),
    ([1], step(frozen=2, layers=TWO_FROZEN, keep_pictures=True, smooth_gloss=True)),
    ([2], step(frozen=2, layers=TWO_FROZEN, keep_pictures=True, sample=1)),
]
"""Iterations in which layers freeze one after the other, and the gloss is smoothed twice."""


def test_layers_that_freeze_and_a_smooth_gloss_are_those_of_the_cpu_engine() -> None:
    scene = three_layers(**TOGETHER)
    mine, true = (loaded(engine, scene, layers=RATES) for engine in (WarpEngine(DEVICE), CpuEngine()))
    for engine in (mine, true):
        for views, scalars in STEPS:
            engine.iterate(views, scalars)
    state, expected = mine.state(learnt=True), true.state(learnt=True)
    for name, array in expected.arrays().items():
        if array.dtype.kind == "f":
            assert apart(state.arrays()[name], array) < CLOSE, name
    assert apart(state.gloss - scene.previous.gloss, expected.gloss - scene.previous.gloss) < 0.05
    log, wanted = mine.log(), true.log()
    assert log.losses == pytest.approx(wanted.losses, rel=CLOSE)
    assert list(log.pictures) == list(wanted.pictures) == [0, 1, 2]
    for view, picture in wanted.pictures.items():
        assert log.pictures[view].every == picture.every
        assert apart(log.pictures[view].planes, picture.planes) < CLOSE
    assert apart(mine.gains(), true.gains()) < CLOSE


def ends(engine: WarpEngine, scene: Case) -> list[np.ndarray]:
    """Returns the results of the iterations above."""
    loaded(engine, scene, layers=RATES)
    for views, scalars in STEPS:
        engine.iterate(views, scalars)
        if views == [4]:
            engine.leave_out([4])
    tables, log = engine.tables(), engine.log()
    psnr = np.array([row.psnr for row in log.rendered])
    return [*tables.clusters, tables.deltas, np.array(log.losses), psnr, engine.gains(), engine.state(True).colours]


@pytest.mark.parametrize("effect", ["all together", "camera gains"])
def test_an_attempt_with_too_little_room_is_repeated(effect: str) -> None:
    scene = three_layers(**{"all together": TOGETHER, **EFFECTS}[effect])
    scene.plan.camera_gains = True
    expected = ends(WarpEngine(DEVICE), scene)
    engine = WarpEngine(DEVICE)
    bind = engine.bind

    def cramped(*given) -> None:  # type: ignore[no-untyped-def]
        bind(*given)
        engine._pictures._rasterizer.capacity = 100  # a picture needs some hundreds

    engine.bind = cramped  # type: ignore[method-assign]
    for mine, true in zip(ends(engine, scene), expected, strict=True):
        assert_repeated(mine, true)
    assert engine._pictures._rasterizer.capacity > 100


def test_a_probe_with_too_little_room_is_repeated() -> None:
    scene = case()
    engine = loaded(WarpEngine(DEVICE), scene)
    errors = engine.probe(Probe(range(5), moved=True, learnt=True))[0]
    engine._pictures._rasterizer.capacity = 100
    engine._pictures._rasterizer.resize(48, 40)
    assert_repeated(engine.probe(Probe(range(5), moved=True, learnt=True))[0], errors)


def test_state_next_downloads_the_state_with_the_losses(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = case(**TOGETHER)
    engine, waits = loaded(WarpEngine(DEVICE), scene), Waits(monkeypatch)
    engine.iterate([0], step())
    engine.probe(Probe(range(5), moved=True, learnt=True), state_next=True)
    state, tables = engine.state(learnt=True), engine.tables()
    assert waits.count == 1
    engine.iterate([1], step())  # what was downloaded is no longer the state
    after = engine.state(learnt=True)
    assert not np.array_equal(after.means, state.means)
    engine.set_tables(tables)
    np.testing.assert_array_equal(engine.state(learnt=True).means, state.means)


@pytest.mark.parametrize("overflow", ["iteration", "probe"])
def test_state_next_is_correct_after_an_overflow(overflow: str) -> None:
    scene, states = case(**TOGETHER), []
    for cramped in ("nothing", overflow):
        engine = loaded(WarpEngine(DEVICE), scene)
        for place in ("iteration", "probe"):
            if cramped == place:
                engine._pictures._rasterizer.capacity = 100
                engine._pictures._rasterizer.resize(48, 40)
            if place == "iteration":
                engine.iterate([0], step())
        engine.probe(Probe(range(5), moved=True, learnt=True), state_next=True)
        states.append(engine.state(learnt=True))
    np.testing.assert_array_equal(states[0].colours, states[1].colours)
    np.testing.assert_array_equal(states[0].means, states[1].means)


def test_more_probes_than_the_log_has_rows_are_refused() -> None:
    engine = loaded(WarpEngine(DEVICE), case())
    with pytest.raises(ValueError, match="cannot render 15 probe views at once"):
        engine.probe(*[Probe(range(5), moved=True, learnt=True)] * 3)


def test_a_long_attempt_is_logged_whole(monkeypatch) -> None:
    scene = case()
    logs = []
    for rows in (1024, 5):
        monkeypatch.setattr(module, "LOG_ROWS", rows)
        engine = loaded(WarpEngine(DEVICE), scene)
        for iteration in range(8):
            engine.iterate([iteration % 5, (iteration + 2) % 5], step(sample=iteration % 2))
        logs.append(engine.log())
    assert logs[0].losses == logs[1].losses
    assert logs[0].rendered == logs[1].rendered


@pytest.mark.parametrize("rooms", ["enough", "too little for an iteration", "too little for a probe"])
def test_captured_graphs_give_the_bits_of_plain_launches(rooms: str, monkeypatch) -> None:
    results = []
    for captures in (False, True):
        monkeypatch.setattr(Graphs, "captures", captures)
        scene, engine = three_layers(**TOGETHER), WarpEngine(DEVICE)
        loaded(engine, scene, layers=RATES)
        if rooms == "too little for an iteration":
            engine._pictures._rasterizer.capacity = 100
            engine._pictures._rasterizer.resize(48, 40)
        for attempt in range(2):
            for round in range(3):
                for views, scalars in STEPS[3 * round : 3 * round + 3] * 3:
                    engine.iterate(views, scalars)
                if rooms == "too little for a probe" and round == 1:
                    engine._pictures._rasterizer.capacity = 100
                    engine._pictures._rasterizer.resize(48, 40)
                    engine._pictures.generation += 1
                engine.probe(Probe(range(5), moved=True, learnt=True))
            results.append([engine.log().losses, engine.tables().deltas, engine.gains(), engine.state(True).colours])
            if attempt == 0:
                engine.load_state(scene.previous)
                engine.set_tables(engine.tables())
                engine.begin(scene.start(layers=RATES))
    half = len(results) // 2
    for plain, captured in zip(results[:half], results[half:], strict=True):
        for one, other in zip(plain, captured, strict=True):
            assert_repeated(one, other)
