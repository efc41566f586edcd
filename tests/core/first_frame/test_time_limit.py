"""The time of frame 0: enough of it changes nothing, too little shortens all phases alike; the clock is a made one."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from box_scene import make_box, make_rig, take_frame

from scas4d_core.captures.frame import InitialPoints
from scas4d_core.first_frame import fit_first_frame, fit_schedule, static_scene
from scas4d_core.first_frame.fit_schedule import MIN_ITERATIONS, FitSchedule
from scas4d_core.first_frame.static_scene import StaticTrainer
from scas4d_core.first_frame.time_limit import STEREO, TimeLimit
from scas4d_core.fit.initial_gaussians import initial_parameters
from scas4d_core.frame_outcome import first_warnings
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import SceneSettings, Settings, StaticSettings
from scas4d_core.update.view_factory import ViewFactory

RIG, BOX = make_rig(), make_box()


class Clock:
    """A clock that goes on when it is told to, and by ``tick`` whenever it is read."""

    def __init__(self, tick: float = 0.0) -> None:
        self.now, self.tick = 0.0, tick

    def __call__(self) -> float:
        self.now += self.tick
        return self.now


def run(iterations: int, seconds: float | None, cost: Callable[[float], float], counts: Callable[[float], float]):
    """A schedule to its end; ``cost``: seconds of an iteration at a moment, ``counts``: Gaussians then."""
    clock = Clock()
    schedule = FitSchedule(iterations, TimeLimit(seconds, clock=clock), counts)
    steps = []
    while schedule.at < iterations:
        steps.append(schedule.begin_iteration())
        clock.now += cost(steps[-1].begun)
        schedule.end_iteration(round(counts(steps[-1].begun)))
    return schedule, steps, clock.now


def test_with_time_enough_every_iteration_counts_one() -> None:
    schedule, steps, spent = run(3000, 100.0, lambda at: 0.03, lambda at: 1000.0)
    assert [step.begun for step in steps] == list(range(3000))
    assert schedule.planned == [(0, 3000)]
    assert spent == pytest.approx(90)


@pytest.mark.parametrize("seconds", [40.0, 60.0, 80.0])
def test_too_little_time_shortens_all_phases_and_is_kept(seconds: float) -> None:
    """The more Gaussians there are, the slower: what comes is foreseen by the number that there will be."""

    def growing(at: float) -> float:
        return 10_000 + 40_000 * min(1.0, max(0.0, at - 200) / 1600)

    schedule, steps, spent = run(3000, seconds, lambda at: 1e-6 * growing(at), growing)
    assert 0.9 * seconds < spent <= 1.01 * seconds
    assert steps[-1].ended == 3000
    assert all(one.ended == two.begun for one, two in pairwise(steps))
    assert MIN_ITERATIONS <= len(steps) < 3000
    assert schedule.planned[-1][1] == pytest.approx(len(steps), rel=0.03)
    assert max(step.ended - step.begun for step in steps[300:]) < 2.2 * np.mean(
        [step.ended - step.begun for step in steps[300:]]
    )


def test_a_machine_that_gets_slower_is_noticed() -> None:
    _, steps, spent = run(3000, 60.0, lambda at: 0.015 if at < 1500 else 0.045, lambda at: 1000.0)
    assert steps[900].ended - steps[900].begun == 1
    assert spent == pytest.approx(60, rel=0.05)


def test_a_few_iterations_are_made_whatever_the_time() -> None:
    _, steps, _ = run(3000, 1e-3, lambda at: 0.05, lambda at: 1000.0)
    assert MIN_ITERATIONS <= len(steps) <= MIN_ITERATIONS + fit_schedule.FIRST_TIMED + fit_schedule.PLAN_EVERY
    _, few, _ = run(300, 1e-3, lambda at: 0.05, lambda at: 1000.0)
    assert len(few) == 300


def test_time_for_another_fit_is_kept() -> None:
    clock = Clock()
    schedule = FitSchedule(1000, TimeLimit(100.0, clock=clock), lambda at: 1000.0)
    schedule.fits_again, schedule.end = True, 500.0
    while schedule.at < 500:
        schedule.begin_iteration()
        clock.now += 0.1
        schedule.end_iteration(1000)
    assert clock.now == pytest.approx(33, rel=0.15)  # 500 of this fit and 1000 of the next
    assert schedule.shortened


def test_a_fit_that_is_slow_at_its_end_alone_is_shortened_too() -> None:
    schedule, _, _ = run(3000, 60.0, lambda at: 0.017 if at < 2950 else 0.3, lambda at: 1000.0)
    assert len(schedule.planned) == 1  # hardly fewer iterations
    assert schedule.shortened
    assert schedule.record == [(0, 3000), (schedule.done, schedule.done)]


def test_a_fit_that_has_time_is_not_shortened() -> None:
    schedule, _, _ = run(300, 60.0, lambda at: 0.01, lambda at: 1000.0)
    assert schedule.done == 300
    assert not schedule.shortened
    assert schedule.record == [(0, 300)]


@pytest.fixture
def trainer(monkeypatch: pytest.MonkeyPatch) -> Callable[[TimeLimit], StaticTrainer]:
    """Makes a trainer of the box scene; densified early, and with a floor of few iterations."""
    monkeypatch.setattr(static_scene, "DENSIFY_FROM", 50)
    monkeypatch.setattr(static_scene, "DENSIFY_EVERY", 50)
    monkeypatch.setattr(fit_schedule, "MIN_ITERATIONS", 40)

    def make(limit: TimeLimit) -> StaticTrainer:
        factory = ViewFactory(RIG)
        views = factory.views(take_frame(0, 0.0, BOX, RIG), {})
        rows = np.random.default_rng(3).permutation(len(BOX))[: len(BOX) // 2]
        cloud = BOX.means[rows].astype(np.float64), BOX.colours[rows], None
        parameters = initial_parameters(*cloud, 1000, np.random.default_rng(0))
        settings = StaticSettings(iterations=300, max_gaussians=900, exposure="auto")
        return StaticTrainer(factory, views, parameters, SceneSettings(), settings, limit)

    return make


def test_a_limit_that_does_not_bind_changes_no_bit(trainer: Callable[[TimeLimit], StaticTrainer]) -> None:
    free, bound = trainer(TimeLimit(None)), trainer(TimeLimit(1e5, clock=Clock(0.001)))
    assert free.train() == bound.train()
    np.testing.assert_array_equal(free.fit.table.parameters, bound.fit.table.parameters)


def test_a_shortened_fit_goes_through_all_phases(trainer: Callable[[TimeLimit], StaticTrainer]) -> None:
    """Rates end where they should, Gaussians are added as always, and each camera's last picture is known."""
    made, rates = trainer(TimeLimit(100.0, clock=Clock(0.25))), []
    own = made._rates

    def noted(at: float) -> np.ndarray:
        rates.append(own(at)[0] / made.radius)
        return own(at)

    made._rates = noted  # type: ignore[method-assign]
    began = len(made.fit)
    assessed: list[bool] = []
    made.exposures.assess = lambda: assessed.append(True)  # type: ignore[method-assign]
    losses = made.train()
    assert 40 <= len(losses) < 250
    assert made.result(losses).planned[-1][1] == pytest.approx(len(losses), abs=5)
    assert rates[0] == pytest.approx(static_scene.RATE_POSITION, rel=1e-3)
    assert rates[-1] == pytest.approx(static_scene.RATE_POSITION_END, rel=0.2)
    assert all(one >= two for one, two in pairwise(rates))
    assert len(made.fit) > 1.1 * began
    assert assessed == [True]
    assert set(made.cameras) == set(RIG.names)
    assert np.mean(losses[-10:]) < 0.8 * np.mean(losses[:10])


def test_a_report_says_what_was_shortened(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fit_schedule, "MIN_ITERATIONS", 30)
    frame, told = take_frame(0, 0.0, BOX, RIG), []
    for seconds, shorter in ((None, False), (1e6, False), (30.0, True)):
        monkeypatch.setattr(fit_first_frame, "TimeLimit", lambda seconds: TimeLimit(seconds, Clock(0.1)))
        settings = Settings(static=StaticSettings(iterations=150, max_gaussians=600, seconds=seconds))
        points = InitialPoints(BOX.means.astype(np.float64), BOX.colours, None)
        scene = Reconstruction.start(RIG, frame, settings, points=points, progress=told.append)
        report = scene.history.report(0)
        assert (report["iterations"] < 150) == shorter == (len(report["planned"]) > 1)
        assert bool(report["shortened"]) == shorter
        if shorter:
            assert f"{report['iterations']} of 150 iterations" in report["shortened"][0]
    assert told[-1].done == told[-1].total
    assert told[-1].detail["seconds_left"] == pytest.approx(0, abs=1)
    assert "seconds_at_most" in told[-1].detail
    assert "seconds_at_most" not in told[0].detail


@pytest.mark.parametrize(("made", "said"), [(199, False), (191, False), (190, True), (120, True)])
def test_a_few_iterations_fewer_are_figures_and_no_warning(
    monkeypatch: pytest.MonkeyPatch, made: int, said: bool
) -> None:
    """A limit that hardly binds: the report has the figure, and nobody is told to mend anything."""
    began = fit_schedule.FitSchedule.begin_iteration

    def hurried(self: FitSchedule) -> fit_schedule.FitStep:
        self.stride = 200 / made if self.done < made - 1 else 200.0
        return began(self)

    monkeypatch.setattr(fit_schedule.FitSchedule, "begin_iteration", hurried)
    settings = Settings(static=StaticSettings(iterations=200, max_gaussians=300, seconds=1e6))
    points = InitialPoints(BOX.means.astype(np.float64), BOX.colours, None)
    scene = Reconstruction.start(RIG, take_frame(0, 0.0, BOX, RIG), settings, points=points)
    report = scene.history.report(0)
    assert report["iterations"] == made
    assert report["planned"][0] == [0, 200]
    assert report["planned"][-1] == [made, made]
    assert [f"{made} of 200 iterations" in text for text in report["shortened"]] == [True] * said
    assert scene.report is not None
    told = [text for text in scene.report.warnings if "not have enough time" in text]
    assert len(told) == said
    assert first_warnings(report) == scene.report.warnings


def test_of_several_ways_the_best_that_ends_in_time_is_chosen() -> None:
    clock = Clock()
    limit = TimeLimit(100.0, clock=clock)
    assert limit.choose(STEREO, [50, 30, 5]) == 1
    clock.now = 34
    assert limit.choose(STEREO, [50, 30, 5]) == 3
    assert TimeLimit(None).choose(STEREO, [1e9]) == 0
