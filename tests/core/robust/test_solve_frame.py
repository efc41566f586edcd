"""A frame is tried until it can be committed: the rungs of the ladder, what is sought, and the patience with it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np
import pytest
from box_scene import take_frame
from frame_cases.footage import SyntheticFootage
from frame_cases.scene import first_state, gone

from scas4d_core.cameras import Rig
from scas4d_core.engines.cpu.renderer import CpuRenderer
from scas4d_core.engines.views import TrainingView
from scas4d_core.frame_outcome import Candidate, FrameOutcome
from scas4d_core.gaussians import Gaussians
from scas4d_core.robust import outliers as judge
from scas4d_core.robust.checks import axis_lengths, brightness, check_brightness
from scas4d_core.robust.checks import with_light as with_light
from scas4d_core.robust.confirmed_errors import ImageErrors
from scas4d_core.robust.outliers import ERROR_RISE, Past
from scas4d_core.robust.solve_frame import FrameSolver
from scas4d_core.robust.update_input import UpdateInput
from scas4d_core.settings import UpdateSettings
from scas4d_core.structure.hierarchy import build_hierarchy
from scas4d_core.update.best_state import COMMITTED, CONFIRMING
from scas4d_core.update.parts import NOTHING, Arrays
from scas4d_core.update.result import AS_CONFIGURED, AttemptOptions, UpdateResult, UpdateTrace, camera_fit
from scas4d_core.update.view_factory import ViewFactory
from scas4d_core.update.warm_start import Motion

FOOTAGE = SyntheticFootage()
RIG: Rig = FOOTAGE.rig
BEFORE = first_state(resting_may_move=False)
AFTER = gone(BEFORE, 0.05)
FRAME = FOOTAGE.frame(1)
NAMES = list(FRAME.images)
BRIGHT = brightness(FRAME.images)
FACTORY = ViewFactory(RIG)
VIEWS = FACTORY.views(FRAME, {})
RENDERER = CpuRenderer((0.0, 0.0, 0.0))
SETTINGS = UpdateSettings(iterations=30, clusters=(2,), max_rejected_frames=3)
LEVEL = 33.0
PAST = judge.past_after_update(Past(), dict.fromkeys(NAMES, LEVEL), BRIGHT, 1.0)
MOTION = Motion([np.zeros((1, 3))], [np.full((1, 3), 0.01)], np.zeros((1, 3)), np.zeros((1, 3)), 0.1)

Answer = Callable[[Gaussians, AttemptOptions], tuple[Gaussians, float]]


class Fake:
    """An updater that answers as it is told: what it makes of a state, and at how many dB it met the cameras."""

    def __init__(self, *answers: Answer) -> None:
        self.hierarchy = build_hierarchy(BEFORE.means, BEFORE.moving, (2,), 8)
        self.answers = list(answers)
        self.options: list[AttemptOptions] = []
        self.starts: list[Gaussians] = []
        self.motions: list[Motion | None] = []

    def run(
        self,
        previous: Gaussians,
        views: list[TrainingView],
        motion: Motion | None,
        seconds: float,
        seed: int,
        options: AttemptOptions = AS_CONFIGURED,
        carried: Mapping[str, Arrays] = NOTHING,
    ) -> UpdateResult:
        self.options.append(options)
        self.starts.append(previous)
        self.motions.append(motion)
        answer = self.answers[min(len(self.options), len(self.answers)) - 1]
        state, psnr = answer(previous, options)
        cameras = {view.name: camera_fit(psnr) for view in views}
        errors = {Candidate.END: dict.fromkeys(NAMES[:2], 0.02)}
        return UpdateResult(state, MOTION, UpdateTrace([0.1], [psnr], cameras=cameras, errors=errors))


def met(psnr: float = LEVEL, state: Gaussians = AFTER) -> Answer:
    return lambda previous, options: (state, psnr)


def broken(previous: Gaussians, options: AttemptOptions) -> tuple[Gaussians, float]:
    return AFTER.replace(means=np.full_like(AFTER.means, np.nan)), LEVEL


def given(past: Past = PAST, **changes: Any) -> UpdateInput:
    asked = UpdateInput(BEFORE, MOTION, 1 / 30, 1 / 30, VIEWS, [], BRIGHT, 1, past, axis_lengths(BEFORE))
    return replace(asked, **changes)


def solve(fake: Fake, asked: UpdateInput, **changes: object) -> tuple[UpdateResult, Past]:
    return FrameSolver(fake, FACTORY, RENDERER, SETTINGS.model_copy(update=changes)).run(asked)


def names(fake: Fake) -> list[str]:
    return [options.name for options in fake.options]


def changed(fake: Fake, patch: pytest.MonkeyPatch, change: Callable[[UpdateTrace], UpdateTrace]) -> None:
    """From here on the fake's traces are changed."""
    run = fake.run

    def other(*asked: Any) -> UpdateResult:
        result = run(*asked)
        return replace(result, trace=change(result.trace))

    patch.setattr(fake, "run", other)


def test_a_frame_that_is_met_is_committed_at_once() -> None:
    fake = Fake(met())
    outcome, after = solve(fake, given())
    assert outcome.gaussians is AFTER
    assert (outcome.outcome, outcome.attempts) == (FrameOutcome.UPDATED, ["as set"])
    assert fake.motions == [MOTION]
    assert after.updates == PAST.updates + 1


def test_the_ladder_is_climbed_in_order_each_from_the_committed_state() -> None:
    fake = Fake(broken, broken, met())
    outcome, _ = solve(fake, given())
    assert names(fake) == ["as set", "smaller steps", "rigid layers only"]
    assert all(start is BEFORE for start in fake.starts)
    assert fake.motions == [MOTION, None, None]
    assert [options.rigid for options in fake.options] == [False, False, True]
    assert outcome.gaussians is AFTER
    assert outcome.outcome is FrameOutcome.RETRIED
    assert "smaller steps" in outcome.reason
    assert len(outcome.attempts) == 3


def test_where_no_rung_holds_the_state_stays_and_says_why() -> None:
    fake = Fake(broken)
    outcome, after = solve(fake, given())
    assert len(fake.options) == 3
    assert outcome.gaussians is BEFORE
    assert outcome.motion is MOTION
    assert outcome.outcome is FrameOutcome.REJECTED_IMPLAUSIBLE
    assert "non-finite" in outcome.reason
    assert (after.rejected, after.updates) == (PAST.rejected + 1, PAST.updates)


def test_an_unmet_frame_is_sought_longer_and_from_where_the_update_ended() -> None:
    fake = Fake(met(LEVEL - 20), met(LEVEL))
    outcome, _ = solve(fake, given())
    assert outcome.gaussians is AFTER
    assert fake.options[1].stopping.most == 5 * SETTINGS.iterations
    assert "20.0 dB less than usual" in outcome.reason
    assert outcome.outcome is FrameOutcome.RELOCATED


@pytest.mark.parametrize(("gap", "factor"), [(1, 1), (2, 2), (3, 3), (40, 3)])
def test_after_missing_frames_an_update_is_longer_up_to_a_limit(gap: int, factor: int) -> None:
    fake = Fake(met())
    solve(fake, given(gap=gap))
    assert fake.options[0].stopping.most == factor * SETTINGS.iterations


def test_what_is_sought_from_where_an_update_ended_has_the_motion_of_both() -> None:
    fake = Fake(met(LEVEL - 3))
    outcome, _ = solve(fake, given(replace(PAST, rejected=1)))
    assert names(fake) == ["as set", "continued from the end of the update"]
    np.testing.assert_array_equal(fake.starts[1].means, AFTER.means)
    np.testing.assert_array_equal(fake.starts[1].colours, BEFORE.colours)  # not those that followed it astray
    assert outcome.motion is MOTION  # no better: the first is taken
    fake = Fake(met(LEVEL - 3), met(LEVEL - 1, gone(BEFORE, 0.06)))
    outcome, _ = solve(fake, given(replace(PAST, rejected=1)))
    assert outcome.motion is not None
    np.testing.assert_allclose(outcome.motion.shifts[0], 2 * MOTION.shifts[0])
    assert outcome.gaussians is not AFTER


def test_nothing_is_sought_from_what_may_not_be_committed() -> None:
    means = AFTER.means.copy()
    means[0] = np.nan
    spoilt = AFTER.replace(means=means)
    for past, psnr in ((PAST, LEVEL - 20), (replace(PAST, rejected=1), LEVEL - 3)):
        fake = Fake(met(psnr, spoilt), lambda previous, options: (previous, LEVEL))
        outcome, _ = solve(fake, given(past))
        assert all(np.isfinite(start.means).all() for start in fake.starts)
        assert np.isfinite(outcome.gaussians.means).all()


def test_a_motion_that_is_not_finite_is_not_carried_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), "MOTION", replace(MOTION, own_shifts=np.full((1, 3), np.nan)))
    assert solve(Fake(met()), given())[0].motion is None


def test_a_frame_that_stands_says_nothing_of_its_cameras(monkeypatch: pytest.MonkeyPatch) -> None:
    suspect = NAMES[0]
    past = replace(PAST, rejected=1, frames_left_out={**PAST.frames_left_out, suspect: 2})
    fake = Fake(met())
    changed(fake, monkeypatch, lambda trace: UpdateTrace(kept=Candidate.PREVIOUS, errors=trace.errors))
    asked = replace(given(past), views=VIEWS[1:], suspects=VIEWS[:1])
    outcome, after = solve(fake, asked)
    assert (outcome.outcome, outcome.reason) == (FrameOutcome.UNCHANGED, "")
    assert (outcome.gaussians is BEFORE, outcome.motion is MOTION) == (True, True)
    assert after == replace(past, rejected=0, lagging_frames=1)


def test_frames_that_follow_others_are_not_sought_longer() -> None:
    fake = Fake(met(LEVEL - 3))
    _, after = solve(fake, given())
    assert names(fake) == ["as set"]
    assert after.lagging_frames == 0


@pytest.mark.parametrize(("left", "tries"), [(-0.01, 1), (0.01, 1), (60.0, 2)])
def test_frames_are_not_sought_longer_than_their_budget(left: float, tries: int) -> None:
    fake = Fake(met(LEVEL - 3))
    asked = replace(given(replace(PAST, rejected=1)), end=perf_counter() + left, iteration_seconds=0.01)
    solve(fake, asked)
    assert len(fake.options) == tries


@pytest.mark.parametrize(("left", "tries"), [(-0.01, 1), (0.01, 1), (60.0, 2)])
def test_what_was_lost_is_not_sought_longer_than_the_budget(left: float, tries: int) -> None:
    fake = Fake(met(LEVEL - 20), met(LEVEL))
    outcome, _ = solve(fake, replace(given(), end=perf_counter() + left, iteration_seconds=0.01))
    assert len(fake.options) == tries
    assert (not outcome.outcome.rejected) == (tries > 1)
    assert any("the time budget is used up" in attempt for attempt in outcome.attempts) == (tries == 1)


def test_what_is_sought_for_a_moment_has_to_meet_its_frame_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = Fake(met(LEVEL - 20))
    counts = iter([64, 1])
    changed(fake, monkeypatch, lambda trace: replace(trace, losses=[0.1] * next(counts)))
    outcome, _ = solve(fake, given(replace(PAST, updates=5, iterations=64)))
    assert (len(fake.options), outcome.outcome) == (2, FrameOutcome.REJECTED_MISFIT)


def test_brighter_pictures_of_a_scene_that_is_not_are_no_other_light() -> None:
    outcome, _ = solve(Fake(met()), given(replace(PAST, light_frames=SETTINGS.max_rejected_frames), exposure=1.2))
    assert (outcome.attempts, outcome.exposure) == (["as set"], 1.0)


def test_pictures_that_stay_brighter_in_the_same_light_are_not_held_for_ever() -> None:
    """Something bright has come in: the cameras tell of no other light, and it is learnt as it is."""
    bright = {name: 2.5 * value for name, value in BRIGHT.items()}
    past, fake = PAST, Fake(met())
    for number in range(1, SETTINGS.max_rejected_frames + 1):
        exposure, _, unusable = check_brightness(past, bright)
        past = with_light(past, exposure)
        assert unusable
        outcome, after = solve(fake, given(past, exposure=exposure, unusable=unusable, brightness=bright))
        past = after
        assert (not outcome.outcome.rejected) == (number == SETTINGS.max_rejected_frames)
    assert outcome.gaussians is AFTER
    np.testing.assert_array_equal(fake.starts[0].colours, BEFORE.colours)
    assert outcome.attempts == ["unchanged lighting, permanently", "as set"]
    assert (check_brightness(past, bright), past.light_frames) == ((1.0, {}, None), 0)


def test_after_a_held_frame_half_of_the_budget_is_kept_for_what_is_sought() -> None:
    now = perf_counter()
    for past, ends in ((PAST, [60.0]), (replace(PAST, rejected=1), [30.0, 60.0])):
        fake = Fake(met(LEVEL - 3), met(LEVEL))
        solve(fake, replace(given(past), end=now + 60.0, iteration_seconds=0.01))
        found = [options.stopping.end for options in fake.options if options.stopping is not None]
        assert [end - now for end in found if end is not None] == pytest.approx(ends, abs=2.0)


def test_after_held_frames_the_level_waits_until_it_is_met_again_but_not_for_ever() -> None:
    past = replace(PAST, rejected=2)
    for number in range(1, judge.CATCH_UP + 1):
        past = solve(Fake(met(LEVEL - 3)), given(past))[1]
        assert (past.rejected, past.lagging_frames, past.level) == (0, number, LEVEL)
    past = solve(Fake(met(LEVEL - 3)), given(past))[1]
    assert past.lagging_frames == 0
    assert past.level < LEVEL
    assert solve(Fake(met(LEVEL)), given(replace(PAST, rejected=2)))[1].lagging_frames == 0


def test_patience_ends_and_then_it_is_taken_as_it_is() -> None:
    past, states = PAST, []
    for _ in range(SETTINGS.max_rejected_frames):
        outcome, after = solve(Fake(met(LEVEL - 20)), given(past))
        past = after
        states.append((outcome.gaussians is BEFORE, outcome.outcome.rejected, past.rejected))
    assert states == [(True, True, 1), (True, True, 2), (False, False, 0)]
    assert "for 3 frames" in outcome.reason
    assert past.level == pytest.approx(LEVEL - 20)
    outcome, _ = solve(Fake(met(LEVEL - 20)), given(past))
    assert outcome.outcome is FrameOutcome.UPDATED


def test_what_is_found_again_as_patience_ends_is_the_scene_as_it_was() -> None:
    past = replace(PAST, updates=5, rejected=SETTINGS.max_rejected_frames - 1)
    outcome, after = solve(Fake(met(LEVEL - 20), met(LEVEL - 4)), given(past))
    assert not outcome.outcome.rejected
    assert "search" in outcome.reason
    assert (after.updates, after.level) == (6, LEVEL)


DARK = {"exposure": 0.02, "unusable": "it is dark"}


def test_a_frame_whose_pictures_say_nothing_is_not_tried() -> None:
    fake = Fake(met())
    outcome, _ = solve(fake, given(**DARK))
    assert fake.options == []
    assert outcome.gaussians is BEFORE
    assert (outcome.outcome, outcome.reason) == (FrameOutcome.REJECTED_UNUSABLE, "it is dark")
    assert outcome.motion is MOTION
    assert (outcome.exposure, outcome.trace.kept) == (0.02, "previous")


def test_darkness_costs_no_patience_and_what_comes_after_is_caught_up_with() -> None:
    past = PAST
    for _ in range(3 * SETTINGS.max_rejected_frames):
        past = solve(Fake(met()), given(past, **DARK))[1]
    assert (past.rejected, past.level) == (0, LEVEL)
    outcome, after = solve(Fake(met(LEVEL - 20)), given(past))
    assert (outcome.outcome, after.rejected) == (FrameOutcome.REJECTED_MISFIT, 1)
    assert solve(Fake(met(LEVEL - 3)), given(past))[1].lagging_frames == 2  # its level waits


def test_a_held_frame_is_told_as_it_is() -> None:
    outcome, _ = solve(Fake(met(LEVEL - 20)), given())
    assert (outcome.outcome, outcome.trace.kept) == (FrameOutcome.REJECTED_MISFIT, "previous")


@pytest.mark.parametrize(("credit", "accepted"), [(16.0, True), (4.0, False)])
def test_a_frame_with_new_content_that_cameras_confirm_is_accepted(
    credit: float, accepted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ImageErrors, "credited_decibels", lambda images, names: dict.fromkeys(names, credit))
    outcome, after = solve(Fake(met(LEVEL - 20)), given(replace(PAST, updates=5)))
    assert outcome.outcome is (FrameOutcome.ACCEPTED if accepted else FrameOutcome.REJECTED_MISFIT)
    assert outcome.outcome.degraded
    assert ("several cameras show the same new content" in outcome.reason) == accepted
    assert any("search" in attempt for attempt in outcome.attempts)  # a jump is searched for first
    assert after.rejected == (0 if accepted else 1)


def psnr_of(state: Gaussians, views: list[TrainingView]) -> float:
    return float(np.mean([one.psnr for one in RENDERER.compare(state, views)]))


def test_a_new_object_is_confirmed_and_noise_is_not() -> None:
    """The state lacks a third ball, which all cameras show. Another frame shows noise of the same error."""
    moving = np.flatnonzero(BEFORE.foreground > 0.5)
    means = 0.6 * (BEFORE.means[moving] - BEFORE.means[moving].mean(axis=0)) + np.float32([-0.15, -0.12, 0.3])
    ball = BEFORE.rows(moving).replace(
        means=means, factors=0.6 * BEFORE.factors[moving], ids=np.arange(1000, 1000 + len(moving))
    )
    shows_ball = FACTORY.views(take_frame(1, 1.0, BEFORE.concatenate(ball), RIG, masks=False), {})
    plain = take_frame(1, 1.0, BEFORE, RIG, masks=False)
    error = np.sqrt(np.mean([np.square(view.target[:3] - old.target[:3]).mean()
                             for view, old in zip(shows_ball, FACTORY.views(plain, {}), strict=True)]))  # fmt: skip
    rng = np.random.default_rng(0)
    noisy = {name: (image + rng.normal(0, 255 * error * 1.4, image.shape)).clip(0, 255).astype(np.uint8)
             for name, image in plain.images.items()}  # fmt: skip
    shows_noise = FACTORY.views(replace(plain, images=noisy), {})
    for views, outcome in ((shows_ball, FrameOutcome.ACCEPTED), (shows_noise, FrameOutcome.REJECTED_MISFIT)):
        level = psnr_of(BEFORE, views)
        assert level < LEVEL - 8
        found, _ = solve(Fake(met(level, BEFORE)), given(replace(PAST, updates=5), views=views))
        assert found.outcome is outcome, (level, found.attempts)


def test_what_is_sought_is_told_with_the_errors_of_the_frame_before(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = Fake(met(LEVEL - 20), met(LEVEL))
    told = iter(
        [
            {Candidate.PREVIOUS: {"c0": 0.5}, Candidate.WARM: {"c0": 0.4}, Candidate.END: {"c0": 0.3}},
            {Candidate.PREVIOUS: {"c0": 0.1}, Candidate.END: {"c0": 0.2}},
        ]
    )
    kept = iter([Candidate.END, Candidate.PREVIOUS])
    changed(fake, monkeypatch, lambda trace: replace(trace, errors=next(told), kept=next(kept)))
    outcome, after = solve(fake, given())
    assert outcome.trace.errors == {"previous": {"c0": 0.5}, "warm": {"c0": 0.4}, "end": {"c0": 0.1}}
    assert (outcome.trace.kept, after.error) == ("end", {"c0": 0.1})


def test_without_the_judge_nothing_is_sought_or_held_but_the_ladder_stands() -> None:
    fake = Fake(met(5.0))
    outcome, _ = solve(fake, given(), reject_outliers=False)
    assert (names(fake), outcome.outcome) == (["as set"], FrameOutcome.UPDATED)
    assert fake.options[0].gate is None
    assert solve(Fake(broken), given(), reject_outliers=False)[0].gaussians is BEFORE


def test_usual_errors_fall_at_once_and_rise_slowly() -> None:
    past = replace(PAST, error=dict.fromkeys(NAMES[:2], 0.01))
    assert solve(Fake(met()), given(past))[1].error == pytest.approx(dict.fromkeys(NAMES[:2], 0.01 * ERROR_RISE))
    past = replace(PAST, error=dict.fromkeys(NAMES[:2], 0.9))
    assert solve(Fake(met()), given(past))[1].error == pytest.approx(dict.fromkeys(NAMES[:2], 0.02))


def test_bounded_axes_are_counted() -> None:
    factors = AFTER.factors.copy()
    factors[:3] *= 1e-4
    outcome, _ = solve(Fake(met(state=AFTER.replace(factors=factors))), given())
    assert outcome.bounded == 9
    assert outcome.outcome is FrameOutcome.UPDATED


def test_suspects_come_back_once_they_fit() -> None:
    suspect = NAMES[0]
    past = replace(
        PAST, frames_left_out={**PAST.frames_left_out, suspect: 2}, camera_levels={**PAST.camera_levels, suspect: -3.0}
    )
    others = [view for view in VIEWS if view.name != suspect]
    level = float(np.median([_shown(view) for view in others]))
    asked = replace(given(past), views=others, suspects=[view for view in VIEWS if view.name == suspect])
    _, after = solve(Fake(met(level, FITTED)), replace(asked, past=replace(asked.past, level=level)))
    assert after.frames_left_out[suspect] == 0


FITTED = gone(BEFORE, 0.08)
"""The truth of frame 1."""


@pytest.mark.parametrize(("shift", "out"), [(0, 0), (8, 1)])
def test_a_camera_that_was_rendered_long_before_the_end_is_rendered_again(
    shift: int, out: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a short update, the last rendering of some cameras is from its start."""
    level = float(np.median([_shown(view) for view in VIEWS]))
    fake, past = Fake(met(level, FITTED)), replace(PAST, updates=5, level=level)
    met_early = {NAMES[0]: camera_fit(level - 9)}
    changed(fake, monkeypatch, lambda trace: replace(trace, cameras={**trace.cameras, **met_early}))
    views = [FACTORY.retouched(VIEWS[0], np.roll(VIEWS[0].target, shift, axis=2)), *VIEWS[1:]]
    assert solve(fake, replace(given(past), views=views))[1].frames_left_out[NAMES[0]] == out


def test_a_state_that_is_wrong_in_all_images_is_not_held_against_one_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    level = float(np.median([_shown(view) for view in VIEWS]))
    fake, past = Fake(met(level, gone(BEFORE, 0.5))), replace(PAST, updates=5, level=level)
    changed(fake, monkeypatch, lambda trace: replace(trace, cameras={**trace.cameras, NAMES[0]: camera_fit(level - 9)}))
    result, after = solve(fake, given(past))
    assert after.frames_left_out[NAMES[0]] == 0
    assert not [alarm for alarm in result.alarms if alarm.camera is not None]


def test_suspects_are_looked_at_in_the_light_that_the_colours_are_in() -> None:
    """Else a camera that fits does not come back while the light is another."""
    suspect, gain = NAMES[0], 1.5
    images = {name: (gain * picture).round().clip(0, 255).astype(np.uint8) for name, picture in FRAME.images.items()}
    bright = FACTORY.views(replace(FRAME, images=images), {})
    level = float(np.median([_shown(view) for view in VIEWS]))
    past = replace(
        PAST,
        frames_left_out={**PAST.frames_left_out, suspect: 2},
        camera_levels={**PAST.camera_levels, suspect: 0.0},
        level=level,
    )
    asked = replace(given(past, exposure=gain), views=bright[1:], suspects=bright[:1])
    outcome, after = solve(Fake(met(level, FITTED)), asked)
    assert outcome.exposure == pytest.approx(gain, rel=0.03)
    assert after.frames_left_out[suspect] == 0


def _shown(view: TrainingView) -> float:
    return RENDERER.compare(FITTED, [view])[0].psnr


def errors(still: float, end: float) -> Callable[[UpdateTrace], UpdateTrace]:
    shown = {Candidate.PREVIOUS: dict.fromkeys(NAMES[:2], still), Candidate.END: dict.fromkeys(NAMES[:2], end)}
    return lambda trace: replace(trace, errors=shown)


@pytest.mark.parametrize(
    ("previous", "end", "tolerance", "looked_at"),
    [(0.021, 0.02, 0.0, CONFIRMING), (0.04, 0.02, 0.0, 0), (0.021, 0.02, -1.0, 0)],
)
def test_what_is_committed_is_looked_at_in_whole_where_the_next_frame_may_stand(
    previous: float, end: float, tolerance: float, looked_at: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake = Fake(met())
    changed(fake, monkeypatch, errors(previous, end))
    _, past = solve(fake, given(), skip_tolerance=tolerance)
    assert sum(name.endswith(COMMITTED) for name in past.error) == looked_at


def test_whole_pictures_confirm_that_a_frame_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    """The frame of the state itself is confirmed by its own errors, one that moved is not."""
    fake = Fake(met(state=BEFORE))
    changed(fake, monkeypatch, errors(0.021, 0.02))
    still = FACTORY.views(FOOTAGE.frame(0), {})
    _, past = solve(fake, given(views=still))
    for views, stands in ((still, True), (VIEWS, False)):
        solve(fake, given(views=views, past=past))
        confirm_skip = fake.options[-1].confirm_skip
        assert confirm_skip is not None
        assert confirm_skip() is stands
    solve(fake, given(views=still))
    confirm_skip = fake.options[-1].confirm_skip
    assert confirm_skip is not None
    assert not confirm_skip()  # nothing is known of a state committed before
