"""Things that enter a small room: where they are found, what is born, and where nothing is."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from scas4d_core.effects.evidence import FitTime, FrameObservation
from scas4d_core.effects.presence import entering
from scas4d_core.effects.presence.carving import carve_new
from scas4d_core.effects.presence.entering import EFFECT, NO_NEWBORNS, SETTLED, find_entered
from scas4d_core.effects.presence.novelty import measure_novelty, novelty_of_views
from scas4d_core.update.result import UpdateResult
from scas4d_core.update.schedule import Stopping
from tests.helpers.effect_cases.visited_room import BALL, CENTRE, known, psnr, scene, seen, sphere, visitor


@pytest.fixture(autouse=True)
def _small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scas4d_core.effects.presence.newborn_fit.ITERATIONS", 120)


def test_a_thing_that_is_new_is_found_where_it_is() -> None:
    found = find_entered(seen(scene(known()), scene(known(), visitor())))
    assert found is not None
    assert found.cameras >= 8
    assert found.share > 0.5
    assert np.abs(found.hull.points.mean(axis=0) - CENTRE).max() < 0.02
    assert np.ptp(found.hull.points, axis=0) == pytest.approx([2 * BALL] * 3, rel=0.35)


def test_what_is_born_shows_it() -> None:
    before = scene(known())
    frame = seen(before, scene(known(), visitor()))
    result = EFFECT.add_and_retire_gaussians(frame)
    born = result.gaussians.rows(np.arange(len(before), len(result.gaussians)))
    assert len(born) > 50
    assert born.moving.all()
    assert (born.ids == -1).all()
    assert result.parents is not None
    assert result.parents.tolist() == [-1] * len(born)
    assert np.median(np.abs(np.linalg.norm(born.means - CENTRE, axis=1) - BALL)) < 0.02
    assert psnr(result.gaussians, frame) > psnr(before, frame) + 8
    for name in ("means", "colours", "factors", "ids"):  # the others stay as they are
        assert np.array_equal(getattr(result.gaussians, name)[: len(before)], getattr(before, name))
    again = find_entered(seen(result.gaussians, scene(known(), visitor())))
    assert again is None  # nothing is left that would be born twice


def test_the_same_frame_bears_the_same_bits() -> None:
    first, second = (EFFECT.add_and_retire_gaussians(seen(scene(known()), scene(known(), visitor()))) for _ in range(2))
    for name, array in first.gaussians.arrays().items():
        assert np.array_equal(array, second.gaussians.arrays()[name]), name


def test_nothing_enters_where_the_state_shows_the_frame() -> None:
    state = scene(known(), visitor())
    frame = seen(state, state)
    assert find_entered(frame) is None
    assert EFFECT.add_and_retire_gaussians(frame) is frame.result
    assert EFFECT.evidence(frame) == entering.Evidence(0.0, "")


def test_what_moved_without_being_followed_has_not_entered() -> None:
    moved = visitor(CENTRE + np.array([0.0, 0.0, -0.35]))
    frame = seen(scene(known(), visitor()), scene(known(), moved))
    assert any(one.new.any() and one.stale.any() for one in novelty_of_views(frame, frame.views))
    assert find_entered(frame) is None


def test_without_masks_the_colours_tell() -> None:
    state = scene(known())
    found = find_entered(seen(state, scene(known(), visitor()), masks=False))
    assert found is not None
    assert np.abs(found.hull.points.mean(axis=0) - CENTRE).max() < 0.04


def test_evidence_says_how_many_cameras_agree_and_outlives_the_birth() -> None:
    frame = seen(scene(known()), scene(known(), visitor()))
    found = EFFECT.evidence(frame)
    assert found is not None
    assert found.share >= EFFECT.on_above
    assert "cameras agree" in found.text
    result = EFFECT.add_and_retire_gaussians(frame)
    later = seen(result.gaussians, scene(known(), visitor()), 6, carried=dict(result.carried))
    after = EFFECT.evidence(later)
    assert after is not None
    assert after.share == pytest.approx(found.share)


def test_the_young_are_settled_and_then_left_alone() -> None:
    true = scene(known(), visitor())
    result = EFFECT.add_and_retire_gaussians(seen(scene(known()), true))
    count, state, carried = len(scene(known())), result.gaussians, dict(result.carried)
    off = state.means.copy()
    off[count:] += np.float32([0.01, 0.0, 0.0])
    frame = seen(state.replace(means=off), true, 6, carried=carried)
    settled = EFFECT.add_and_retire_gaussians(frame)
    assert psnr(settled.gaussians, frame) > psnr(frame.result.gaussians, frame) + 1
    assert np.array_equal(settled.gaussians.opacities, state.opacities)
    grown_up = {**carried, "entering": {**carried["entering"], "age": np.full(len(state) - count, SETTLED)}}
    later = seen(state.replace(means=off), true, 7, carried=grown_up)
    assert np.array_equal(EFFECT.add_and_retire_gaussians(later).gaussians.means, off)


def test_no_voxel_is_free_to_a_camera() -> None:
    state = scene(known())
    frame = seen(state, scene(known(), visitor()))
    says = measure_novelty(state, state.colours, frame.views, frame.rig, frame.renderer)
    hull = carve_new(says)
    for one in says:
        uv, _ = one.camera.project(hull.points)
        column, row = np.clip(uv.astype(int), 0, 79).T
        assert (one.new | one.covered)[row, column].mean() > 0.85


def test_what_comes_back_is_revived_as_itself() -> None:
    gone = scene(known(), visitor([0.1, -3.0, 0.0]))
    rows = np.arange(len(gone) - 300, len(gone))
    frame = seen(gone.retire(rows), scene(known(), visitor()))
    result = EFFECT.add_and_retire_gaussians(frame)
    assert len(result.gaussians) == len(gone)  # none is born
    assert not result.gaussians.retired.any()
    assert np.array_equal(result.gaussians.ids, gone.ids)
    assert np.abs(result.gaussians.means[rows].mean(axis=0) - CENTRE).max() < 0.03
    assert result.carried["entering"]["newborn"].tolist() == rows.tolist()  # it is looked for in the next frame


def test_another_thing_is_not_taken_for_what_has_left() -> None:
    gone = scene(known(), sphere(np.array([0.1, -3.0, 0.0]), BALL, phase=0.0))
    frame = seen(gone.retire(np.arange(len(gone) - 300, len(gone))), scene(known(), visitor()))
    result = EFFECT.add_and_retire_gaussians(frame)
    assert len(result.gaussians) > len(gone)
    assert result.gaussians.retired.sum() == 300


def test_what_no_camera_confirms_is_retired() -> None:
    count, state = len(scene(known())), scene(known(), visitor())
    carried = {"entering": NO_NEWBORNS | {"rows": np.arange(count, len(state)), "age": np.full(300, SETTLED)}}
    gone = EFFECT.add_and_retire_gaussians(seen(state, scene(known()), 9, carried=carried)).gaussians
    assert gone.retired[count:].mean() > 0.8
    assert not gone.retired[:count].any()
    assert not EFFECT.add_and_retire_gaussians(seen(state, state, 9, carried=carried)).gaussians.retired.any()


class Ticks:
    """A clock that goes on by a tick whenever it is looked at."""

    now = 0.0

    def __call__(self) -> float:
        self.now += 1.0
        return self.now


def timed(monkeypatch: pytest.MonkeyPatch, end: float) -> tuple[FrameObservation, UpdateResult]:
    """A frame with a thing that is new and what comes of it, by a clock that ticks."""
    clock = Ticks()
    monkeypatch.setattr("scas4d_core.update.schedule.Stopping", partial(Stopping, clock=clock))
    monkeypatch.setattr("scas4d_core.effects.presence.newborn_fit.perf_counter", clock)
    frame = replace(seen(scene(known()), scene(known(), visitor())), time=FitTime(end))
    return frame, EFFECT.add_and_retire_gaussians(frame)


def test_what_there_is_no_time_for_is_not_born_and_the_frame_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    for end in (0.5, 25.0):  # of 120 iterations none, or some twenty
        frame, result = timed(monkeypatch, end)
        assert result is frame.result
        assert len(frame.time.postponed) == 1
        assert "moving Gaussians were not added" in frame.time.postponed[0]


def test_with_some_time_it_is_fitted_in_fewer_iterations(monkeypatch: pytest.MonkeyPatch) -> None:
    frame, result = timed(monkeypatch, 60.0)
    assert frame.time.postponed == []
    assert frame.time.spent == pytest.approx(60, abs=3)
    assert psnr(result.gaussians, frame) > psnr(frame.result.gaussians, frame) + 3
    assert frame.time.end is not None


def test_without_time_the_young_stay_as_they_are() -> None:
    true = scene(known(), visitor())
    rows = np.arange(len(scene(known())), len(true))
    carried = {"entering": NO_NEWBORNS | {"rows": rows, "age": np.zeros(len(rows), np.int64)}}
    frame = replace(seen(true, true, 6, carried=carried), time=FitTime(0.0))
    assert EFFECT.add_and_retire_gaussians(frame).gaussians is true
    assert frame.time.postponed == [f"{len(rows)} recently added Gaussians were not refined"]
