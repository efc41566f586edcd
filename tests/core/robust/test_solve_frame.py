"""A frame is tried until it can be committed: the rungs of the ladder, what is sought, and the patience with it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np
import pytest

from scas4d_core.cameras import Rig
from scas4d_core.gaussians import Gaussians
from scas4d_core.robust import outliers as judge
from scas4d_core.robust.attempts import Course, axis_lengths
from scas4d_core.robust.outliers import Look, Past
from scas4d_core.robust.solve_frame import ERROR_RISE, Given, Trial
from scas4d_core.settings import UpdateSettings
from scas4d_core.structure.hierarchy import build_hierarchy
from scas4d_core.update.picture_loss import PictureLoss
from scas4d_core.update.result import CameraFit, Updated
from scas4d_core.update.stopping import Timed
from scas4d_core.update.views import TrainingView, ViewFactory
from scas4d_core.update.warm_start import Motion
from studies.hard_frames.footage import SyntheticFootage
from studies.hard_frames.scene import first_state, gone

FOOTAGE = SyntheticFootage()
RIG: Rig = FOOTAGE.rig
BEFORE = first_state(resting_may_move=False)
AFTER = gone(BEFORE, 0.05)
FRAME = FOOTAGE.frame(1)
NAMES = list(FRAME.images)
BRIGHT = judge.brightness(FRAME.images)
FACTORY = ViewFactory(RIG)
VIEWS = FACTORY.views(FRAME, {})
PICTURE = PictureLoss(FACTORY, (0.0, 0.0, 0.0), 1.0, 0.0)
SETTINGS = UpdateSettings(iterations=30, clusters=(2,), patience=3)
LEVEL = 33.0
PAST = judge.settle(Past(), dict.fromkeys(NAMES, LEVEL), BRIGHT, 1.0)
MOTION = Motion([np.zeros((1, 3))], [np.full((1, 3), 0.01)], np.zeros((1, 3)), np.zeros((1, 3)), 0.1)

Answer = Callable[[Gaussians, Course], tuple[Gaussians, float]]


class Fake:
    """An updater that answers as it is told: what it makes of a state, and at how many dB it met the cameras."""

    def __init__(self, *answers: Answer) -> None:
        self.hierarchy = build_hierarchy(BEFORE.means, BEFORE.moving, (2,), 8)
        self.answers = list(answers)
        self.courses: list[Course] = []
        self.starts: list[Gaussians] = []
        self.motions: list[Motion | None] = []

    def run(
        self,
        previous: Gaussians,
        views: list[TrainingView],
        motion: Motion | None,
        seconds: float,
        seed: int,
        course: Course | None = None,
    ) -> Updated:
        assert course is not None
        self.courses.append(course)
        self.starts.append(previous)
        self.motions.append(motion)
        answer = self.answers[min(len(self.courses), len(self.answers)) - 1]
        state, psnr = answer(previous, course)
        cameras = {view.name: CameraFit(psnr) for view in views}
        errors = {"end": dict.fromkeys(NAMES[:2], 0.02)}
        return Updated(state, MOTION, [0.1], [psnr], {}, cameras, errors=errors)


def met(psnr: float = LEVEL, state: Gaussians = AFTER) -> Answer:
    return lambda previous, course: (state, psnr)


def broken(previous: Gaussians, course: Course) -> tuple[Gaussians, float]:
    return AFTER.replace(means=np.full_like(AFTER.means, np.nan)), LEVEL


def given(past: Past = PAST, look: Look = Look()) -> Given:
    return Given(BEFORE, MOTION, 1 / 30, 1 / 30, VIEWS, [], BRIGHT, 1, past, look, lengths=axis_lengths(BEFORE))


def trial(fake: Fake, **changes: object) -> Trial:
    return Trial(fake, FACTORY, PICTURE, SETTINGS.model_copy(update=changes))


def names(fake: Fake) -> list[str]:
    return [course.manner.name for course in fake.courses]


def test_a_frame_that_is_met_is_committed_at_once() -> None:
    fake = Fake(met())
    outcome = trial(fake).run(given())
    assert outcome.gaussians is AFTER
    assert (outcome.degraded, outcome.attempts, outcome.fresh) == (None, ["as set"], True)
    assert fake.motions == [MOTION]
    assert outcome.past.updates == PAST.updates + 1


def test_the_ladder_is_climbed_in_order_each_from_the_committed_state() -> None:
    fake = Fake(broken, broken, met())
    outcome = trial(fake).run(given())
    assert names(fake) == ["as set", "smaller steps", "rigid layers only"]
    assert all(start is BEFORE for start in fake.starts)
    assert fake.motions == [MOTION, None, None]
    assert [course.manner.rigid for course in fake.courses] == [False, False, True]
    assert outcome.gaussians is AFTER
    assert outcome.degraded is not None
    assert "smaller steps" in outcome.degraded
    assert len(outcome.attempts) == 3


def test_where_no_rung_holds_the_state_stays_and_says_why() -> None:
    fake = Fake(broken)
    outcome = trial(fake).run(given())
    assert len(fake.courses) == 3
    assert outcome.gaussians is BEFORE
    assert outcome.motion is MOTION
    assert not outcome.fresh
    assert "not finite" in str(outcome.degraded)
    assert (outcome.past.held, outcome.past.updates) == (PAST.held + 1, PAST.updates)


def test_an_unmet_frame_is_sought_longer_and_from_where_the_update_ended() -> None:
    fake = Fake(met(LEVEL - 20), met(LEVEL))
    outcome = trial(fake).run(given())
    assert outcome.gaussians is AFTER
    assert fake.courses[1].pace.most == 5 * SETTINGS.iterations
    assert "20.0 dB less than usual" in str(outcome.degraded)
    assert outcome.fresh


def test_what_is_sought_from_where_an_update_ended_has_the_motion_of_both() -> None:
    fake = Fake(met(LEVEL - 3))
    outcome = trial(fake).run(given(replace(PAST, held=1)))
    assert names(fake) == ["as set", "on from where the update ended"]
    assert fake.starts[1] is AFTER
    assert outcome.motion is MOTION  # no better: the first is taken
    fake = Fake(met(LEVEL - 3), met(LEVEL - 1, gone(BEFORE, 0.06)))
    outcome = trial(fake).run(given(replace(PAST, held=1)))
    assert outcome.motion is not None
    np.testing.assert_allclose(outcome.motion.shifts[0], 2 * MOTION.shifts[0])
    assert outcome.gaussians is not AFTER


def test_nothing_is_sought_from_what_may_not_be_committed() -> None:
    means = AFTER.means.copy()
    means[0] = np.nan
    spoilt = AFTER.replace(means=means)
    for past, psnr in ((PAST, LEVEL - 20), (replace(PAST, held=1), LEVEL - 3)):
        fake = Fake(met(psnr, spoilt), lambda previous, course: (previous, LEVEL))
        outcome = trial(fake).run(given(past))
        assert all(np.isfinite(start.means).all() for start in fake.starts)
        assert np.isfinite(outcome.gaussians.means).all()


def test_a_motion_that_is_not_finite_is_not_carried_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), "MOTION", replace(MOTION, rest=np.full((1, 3), np.nan)))
    assert trial(Fake(met())).run(given()).motion is None


def test_a_frame_that_stands_says_nothing_of_its_cameras(monkeypatch: pytest.MonkeyPatch) -> None:
    suspect = NAMES[0]
    past = replace(PAST, held=1, cameras={**PAST.cameras, suspect: replace(PAST.of(suspect), out=2)})
    fake = Fake(met())
    run = fake.run
    monkeypatch.setattr(fake, "run", lambda *asked: replace(run(*asked), losses=[], psnr=[], cameras={}, kept="still"))
    asked = replace(given(past), views=VIEWS[1:], suspects=VIEWS[:1])
    outcome = trial(fake).run(asked)
    assert (outcome.stood, outcome.fresh, outcome.degraded) == (True, True, None)
    assert (outcome.gaussians is BEFORE, outcome.motion is MOTION) == (True, True)
    assert outcome.past == replace(past, held=0, behind=1)


def test_frames_that_follow_others_are_not_sought_longer() -> None:
    fake = Fake(met(LEVEL - 3))
    outcome = trial(fake).run(given())
    assert names(fake) == ["as set"]
    assert outcome.past.behind == 0


@pytest.mark.parametrize(("left", "tries"), [(-0.01, 1), (0.01, 1), (60.0, 2)])
def test_frames_are_not_sought_longer_than_their_budget(left: float, tries: int) -> None:
    fake = Fake(met(LEVEL - 3))
    asked = replace(given(replace(PAST, held=1)), end=perf_counter() + left, each=0.01)
    trial(fake).run(asked)
    assert len(fake.courses) == tries


@pytest.mark.parametrize(("left", "tries"), [(-0.01, 1), (0.01, 1), (60.0, 2)])
def test_what_was_lost_is_not_sought_longer_than_the_budget(left: float, tries: int) -> None:
    fake = Fake(met(LEVEL - 20), met(LEVEL))
    outcome = trial(fake).run(replace(given(), end=perf_counter() + left, each=0.01))
    assert len(fake.courses) == tries
    assert outcome.fresh == (tries > 1)
    assert any("the budget is spent" in attempt for attempt in outcome.attempts) == (tries == 1)


def test_what_is_sought_for_a_moment_has_to_meet_its_frame_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = Fake(met(LEVEL - 20))
    run, counts = fake.run, iter([64, 1])
    monkeypatch.setattr(fake, "run", lambda *asked: replace(run(*asked), losses=[0.1] * next(counts)))
    outcome = trial(fake).run(given(replace(PAST, updates=5, iterations=64)))
    assert (len(fake.courses), outcome.fresh) == (2, False)


def test_brighter_pictures_of_a_scene_that_is_not_are_no_other_light() -> None:
    outcome = trial(Fake(met())).run(given(replace(PAST, lit=SETTINGS.patience), Look(1.2)))
    assert (outcome.attempts, outcome.exposure) == (["as set"], 1.0)


def test_pictures_that_stay_brighter_in_the_same_light_are_not_held_for_ever() -> None:
    """Something bright has come in: the cameras tell of no other light, and it is learnt as it is."""
    bright = {name: 2.5 * value for name, value in BRIGHT.items()}
    past, fake = PAST, Fake(met())
    for number in range(1, SETTINGS.patience + 1):
        look = judge.look(past, bright)
        past = judge.lit(past, look)
        assert look.held
        outcome = trial(fake).run(replace(given(past, look), brightness=bright))
        past = outcome.past
        assert outcome.fresh == (number == SETTINGS.patience)
    assert outcome.gaussians is AFTER
    np.testing.assert_array_equal(fake.starts[0].colours, BEFORE.colours)
    assert outcome.attempts == ["the same light, for good", "as set"]
    assert (judge.look(past, bright), past.lit) == (Look(), 0)


def test_after_a_held_frame_half_of_the_budget_is_kept_for_what_is_sought() -> None:
    now = perf_counter()
    for past, ends in ((PAST, [60.0]), (replace(PAST, held=1), [30.0, 60.0])):
        fake = Fake(met(LEVEL - 3), met(LEVEL))
        trial(fake).run(replace(given(past), end=now + 60.0, each=0.01))
        paces = [course.pace for course in fake.courses]
        assert [pace.end - now for pace in paces if isinstance(pace, Timed)] == pytest.approx(ends, abs=2.0)


def test_after_held_frames_the_level_waits_until_it_is_met_again_but_not_for_ever() -> None:
    past = replace(PAST, held=2)
    for number in range(1, judge.CATCH_UP + 1):
        past = trial(Fake(met(LEVEL - 3))).run(given(past)).past
        assert (past.held, past.behind, past.level) == (0, number, LEVEL)
    past = trial(Fake(met(LEVEL - 3))).run(given(past)).past
    assert past.behind == 0
    assert past.level < LEVEL
    assert trial(Fake(met(LEVEL))).run(given(replace(PAST, held=2))).past.behind == 0


def test_patience_ends_and_then_it_is_taken_as_it_is() -> None:
    past, states = PAST, []
    for _ in range(SETTINGS.patience):
        outcome = trial(Fake(met(LEVEL - 20))).run(given(past))
        past = outcome.past
        states.append((outcome.gaussians is BEFORE, outcome.fresh, past.held))
    assert states == [(True, False, 1), (True, False, 2), (False, True, 0)]
    assert "for 3 frames" in str(outcome.degraded)
    assert past.level == pytest.approx(LEVEL - 20)
    after = trial(Fake(met(LEVEL - 20))).run(given(past))
    assert after.degraded is None


def test_what_is_found_again_as_patience_ends_is_the_scene_as_it_was() -> None:
    past = replace(PAST, updates=5, held=SETTINGS.patience - 1)
    outcome = trial(Fake(met(LEVEL - 20), met(LEVEL - 4))).run(given(past))
    assert outcome.fresh
    assert "sought" in str(outcome.degraded)
    assert (outcome.past.updates, outcome.past.level) == (6, LEVEL)


DARK = Look(0.02, held="it is dark")


def test_a_frame_whose_pictures_say_nothing_is_not_tried() -> None:
    fake = Fake(met())
    outcome = trial(fake).run(given(look=DARK))
    assert fake.courses == []
    assert outcome.gaussians is BEFORE
    assert (outcome.degraded, outcome.fresh, outcome.motion is MOTION) == ("held as it was: it is dark", False, True)
    assert (outcome.exposure, outcome.updated.kept) == (0.02, "still")


def test_darkness_costs_no_patience_and_what_comes_after_is_caught_up_with() -> None:
    past = PAST
    for _ in range(3 * SETTINGS.patience):
        past = trial(Fake(met())).run(given(past, DARK)).past
    assert (past.held, past.level) == (0, LEVEL)
    outcome = trial(Fake(met(LEVEL - 20))).run(given(past))
    assert (outcome.fresh, outcome.past.held) == (False, 1)
    assert trial(Fake(met(LEVEL - 3))).run(given(past)).past.behind == 2  # its level waits


def test_a_held_frame_is_told_as_it_is() -> None:
    outcome = trial(Fake(met(LEVEL - 20))).run(given())
    assert (outcome.fresh, outcome.updated.kept) == (False, "still")


def test_what_is_sought_is_told_with_the_errors_of_the_frame_before(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = Fake(met(LEVEL - 20), met(LEVEL))
    told = iter(
        [{"still": {"c0": 0.5}, "warm": {"c0": 0.4}, "end": {"c0": 0.3}}, {"still": {"c0": 0.1}, "end": {"c0": 0.2}}]
    )
    kept, run = iter(["end", "still"]), fake.run
    monkeypatch.setattr(fake, "run", lambda *asked: replace(run(*asked), errors=next(told), kept=next(kept)))
    outcome = trial(fake).run(given())
    assert outcome.updated.errors == {"still": {"c0": 0.5}, "warm": {"c0": 0.4}, "end": {"c0": 0.1}}
    assert (outcome.updated.kept, outcome.past.error) == ("end", {"c0": 0.1})


def test_without_the_judge_nothing_is_sought_or_held_but_the_ladder_stands() -> None:
    fake = Fake(met(5.0))
    outcome = trial(fake, judge=False).run(given())
    assert (names(fake), outcome.degraded) == (["as set"], None)
    assert fake.courses[0].gate is None
    assert trial(Fake(broken), judge=False).run(given()).gaussians is BEFORE


def test_usual_errors_fall_at_once_and_rise_slowly() -> None:
    past = replace(PAST, error=dict.fromkeys(NAMES[:2], 0.01))
    assert trial(Fake(met())).run(given(past)).past.error == pytest.approx(dict.fromkeys(NAMES[:2], 0.01 * ERROR_RISE))
    past = replace(PAST, error=dict.fromkeys(NAMES[:2], 0.9))
    assert trial(Fake(met())).run(given(past)).past.error == pytest.approx(dict.fromkeys(NAMES[:2], 0.02))


def test_bounded_axes_are_counted() -> None:
    factors = AFTER.factors.copy()
    factors[:3] *= 1e-4
    outcome = trial(Fake(met(state=AFTER.replace(factors=factors)))).run(given())
    assert outcome.bounded == 9
    assert outcome.degraded is None


def test_suspects_come_back_once_they_fit() -> None:
    suspect = NAMES[0]
    cameras = {**PAST.cameras, suspect: replace(PAST.of(suspect), out=2, place=-3.0)}
    others = [view for view in VIEWS if view.name != suspect]
    level = float(np.median([_shown(view) for view in others]))
    asked = replace(
        given(replace(PAST, cameras=cameras)), views=others, suspects=[view for view in VIEWS if view.name == suspect]
    )
    outcome = trial(Fake(met(level, FITTED))).run(replace(asked, past=replace(asked.past, level=level)))
    assert outcome.past.of(suspect).out == 0


FITTED = gone(BEFORE, 0.08)
"""The truth of frame 1."""


@pytest.mark.parametrize(("end", "out"), [(FITTED, 0), (gone(BEFORE, 0.5), 1)])
def test_a_camera_that_was_rendered_long_before_the_end_is_looked_at_again(
    end: Gaussians, out: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a short update the last picture of some cameras is that of its start."""
    level = float(np.median([_shown(view) for view in VIEWS]))
    fake, past = Fake(met(level, end)), replace(PAST, updates=5, level=level)
    run = fake.run

    def early(*asked: Any) -> Updated:
        updated = run(*asked)
        return replace(updated, cameras={**updated.cameras, NAMES[0]: CameraFit(level - 9)})

    monkeypatch.setattr(fake, "run", early)
    assert trial(fake).run(given(past)).past.of(NAMES[0]).out == out


def test_suspects_are_looked_at_in_the_light_that_the_colours_are_in() -> None:
    """Else a camera that fits does not come back while the light is another."""
    suspect, gain = NAMES[0], 1.5
    images = {name: (gain * picture).round().clip(0, 255).astype(np.uint8) for name, picture in FRAME.images.items()}
    bright = FACTORY.views(replace(FRAME, images=images), {})
    level = float(np.median([_shown(view) for view in VIEWS]))
    cameras = {**PAST.cameras, suspect: replace(PAST.of(suspect), out=2, place=0.0)}
    asked = replace(
        given(replace(PAST, cameras=cameras, level=level), Look(gain)), views=bright[1:], suspects=bright[:1]
    )
    outcome = trial(Fake(met(level, FITTED))).run(asked)
    assert outcome.exposure == pytest.approx(gain, rel=0.03)
    assert outcome.past.of(suspect).out == 0


def _shown(view: TrainingView) -> float:
    features = np.concatenate([FITTED.colours, FITTED.foreground[:, None]], axis=1)
    PICTURE.measure(FITTED.means, FITTED.factors, FITTED.opacities, features, view)
    return PICTURE.psnr
