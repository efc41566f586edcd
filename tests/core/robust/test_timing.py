"""The moments of cameras' pictures: found where motion tells them, silent where it does not, and no state changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from frame_cases.footage import SyntheticFootage, shown_out_of_step

from scas4d_core.engines.renderer import extrapolated
from scas4d_core.frame_outcome import Candidate, FrameOutcome, timing_warnings
from scas4d_core.frame_report import FrameReport
from scas4d_core.gaussians import Gaussians
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.robust import timing
from scas4d_core.robust.outliers import Past
from scas4d_core.robust.timing import (
    APART,
    CAMERAS,
    FARTHEST,
    MAX_ERROR,
    OFF,
    CameraTimingSums,
    PictureTiming,
    astuple,
    measure_shift,
)
from scas4d_core.storage.history import History
from studies.constants import all_varied

FOOTAGE = SyntheticFootage()
APART_BY = {"c3": 0.5, "c7": -0.5}
SIZE = 48


def shown(moment: float, speed: float = 3.0) -> np.ndarray:
    """[3, SIZE, SIZE] a striped disc on grey that goes right, pixels a frame."""
    v, u = np.mgrid[:SIZE, :SIZE] + 0.5
    x, y = u - SIZE / 2 - speed * moment, v - SIZE / 2
    inside = 1 / (1 + np.exp(np.hypot(x, y) - 12))
    stripes = [0.5 + 0.3 * np.sin((x + y) / step) for step in (2.5, 3.5, 5)]
    return np.stack([0.2 + (stripe - 0.2) * inside for stripe in stripes]).astype(np.float32)


def look(target: np.ndarray, speed: float = 3.0) -> PictureTiming:
    found = measure_shift(target, shown(0, speed), shown(0.5, speed), shown(-0.5, speed))
    assert found is not None
    return found


@pytest.mark.parametrize("moment", [-0.5, -0.33, -0.25, 0.0, 0.25, 0.33, 0.5])
@pytest.mark.parametrize("speed", [0.5, 3.0])
def test_the_moment_of_a_picture_is_found(moment: float, speed: float) -> None:
    found = look(shown(moment, speed), speed)
    assert abs(found.offset - moment) < 0.06
    assert found.variance < 0.05**2


def test_gain_offset_noise_and_things_in_the_way_do_not_pass_for_a_moment() -> None:
    rng = np.random.default_rng(0)
    target = 1.2 * shown(0.3) + 0.04 + rng.normal(0, 0.01, (3, SIZE, SIZE))
    target[:, 20:28, 20:28] = 0.7
    assert abs(look(target.astype(np.float32)).offset - 0.3) < 0.06
    clean = 0.9 * shown(0.0) - 0.03 + rng.normal(0, 0.01, (3, SIZE, SIZE))
    assert abs(look(clean.astype(np.float32)).offset) < 0.03


def test_cut_off_pixels_are_not_asked() -> None:
    target = shown(0.4)
    target[:, :, :24] = 1.0
    assert abs(look(target).offset - 0.4) < 0.06


def test_what_hardly_changes_tells_nothing() -> None:
    assert measure_shift(shown(0.5), shown(0), shown(0), shown(0)) is None
    assert measure_shift(shown(0.5, 0.01), shown(0), shown(0.5, 0.01), shown(-0.5, 0.01)) is None


def test_what_noise_hides_is_uncertain() -> None:
    noise = np.random.default_rng(1).normal(0, 0.2, (3, SIZE, SIZE))
    assert look((shown(0.2) + noise).astype(np.float32)).variance > 100 * look(shown(0.2)).variance


def after(
    looks: Mapping[float, int], way: float = 0.1, frame: float = 0.1, start: CameraTimingSums | None = None
) -> CameraTimingSums:
    found = start or CameraTimingSums()
    for offset, times in looks.items():
        for _ in range(times):
            found = found.with_picture(PictureTiming(offset, 1e-4), way, frame)
    return found


def test_looks_make_a_mean_with_its_error() -> None:
    steady, spread = after({0.3: 4}), after({0.1: 2, 0.5: 2})
    assert steady.mean == pytest.approx(0.3)
    assert steady.error == pytest.approx(APART)
    assert spread.mean == pytest.approx(0.3, abs=0.02)
    assert 0.1 < spread.error < 0.13
    assert after({0.3: 1}).error == np.inf


def test_a_longer_way_is_no_larger_offset() -> None:
    assert after({0.15: 4}, way=0.2, frame=0.1).mean == pytest.approx(0.3)
    assert after({0.15: 4}, way=0.2, frame=0.2).mean == pytest.approx(0.15)


def test_a_gap_does_not_count_as_much_as_the_frames_that_it_replaces() -> None:
    before = after({0.3: 20})
    for gap in (1.0, 86_400.0):
        with_gap = after({-0.5: 1}, way=gap, frame=gap, start=before)
        assert with_gap.mean == pytest.approx(0.3, abs=0.02)
    slower = after({0.3: 200}, way=1.0, frame=1.0, start=before)  # for good
    assert slower.frame / slower.weight == pytest.approx(1.0, abs=0.01)


def test_the_mean_forgets_and_one_look_is_bounded() -> None:
    before = after({0.0: 60})
    assert after({0.4: 60}, start=before).mean > 0.36
    assert after({1e6: 1}, start=before).mean < 0.06 * FARTHEST


def past_of(offsets: Mapping[str, Mapping[float, int]]) -> Past:
    return replace(Past(), timing={name: astuple(after(looks)) for name, looks in offsets.items()})


def test_the_median_of_the_cameras_is_0_and_those_little_known_are_not_told() -> None:
    four = {"a": {0.2: 5}, "b": {0.21: 5}, "c": {0.19: 5}, "d": {0.6: 5}}
    found = timing.timings(past_of({**four, "new": {0.2: 1}, "wild": {-0.6: 3, 0.6: 3}}))
    assert found.keys() == four.keys()
    assert found["d"]["frames"] == pytest.approx(0.395)
    assert sorted(abs(one["frames"]) for one in found.values())[:3] == pytest.approx([0.005, 0.005, 0.015])
    assert all(one["error"] <= MAX_ERROR for one in found.values())
    few = dict(list(four.items())[: CAMERAS - 1])
    assert timing.timings(past_of(few)) == {}


def test_who_is_clearly_off_is_named() -> None:
    steady = {name: {0.0: 6} for name in "abcd"}
    wild = {0.0: 6, 0.6: 6}
    found = timing.timings(past_of({**steady, "near": {0.14: 6}, "late": {0.3: 6}, "early": {-0.4: 6}, "wild": wild}))
    assert found["wild"]["frames"] > OFF
    assert {name for name, one in found.items() if one["out_of_step"]} == {"late", "early"}
    (told,) = timing_warnings(found)
    assert "'early' is early, 'late' is late;" in told  # no figures: they change from frame to frame, and it does not
    assert timing_warnings(None) == []


def test_looks_go_through_arrays() -> None:
    past = past_of({"a": {0.2: 5}, "b": {0.1: 2}})
    arrays = past.arrays()
    assert Past.of_arrays(arrays).timing == past.timing
    assert Past.of_arrays(Past().arrays()).timing == {}


def play(scene: Reconstruction, indices: range, offsets: Mapping[str, float]) -> list[FrameReport]:
    return [scene.step(shown_out_of_step(FOOTAGE, index, offsets)) for index in indices]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Reconstruction, list[FrameReport]]:
    """Cameras out of step, to the end."""
    scene = FOOTAGE.start(tmp_path_factory.mktemp("timing") / "scene")
    return scene, play(scene, range(1, 19), APART_BY)


def test_cameras_out_of_step_are_found_and_named(undisturbed: tuple[Reconstruction, list[FrameReport]]) -> None:
    found = undisturbed[1][-1].timing
    assert found["c3"]["frames"] > 0.3
    assert found["c7"]["frames"] < -0.3
    assert all(abs(one["frames"]) < 0.1 for name, one in found.items() if name not in APART_BY)
    assert undisturbed[1][0].timing == {}  # a look or two say nothing
    (told,) = timing_warnings(undisturbed[0].history.report(18)["timing"])
    assert "'c3' is late, 'c7' is early;" in told


def test_a_scene_goes_on_with_its_looks(undisturbed: tuple[Reconstruction, list[FrameReport]], tmp_path: Path) -> None:
    play(FOOTAGE.start(tmp_path / "scene"), range(1, 9), APART_BY)
    with all_varied(FOOTAGE.constants):
        again = Reconstruction.resume(FOOTAGE.rig, FOOTAGE.settings, History.open(tmp_path / "scene"))
    assert again.resumed is not None
    assert not again.resumed.cold
    assert again._prepared.carried.past.timing
    assert play(again, range(9, 19), APART_BY)[-1].timing == undisturbed[1][-1].timing


def test_no_state_hangs_on_it(
    undisturbed: tuple[Reconstruction, list[FrameReport]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(timing, "record_timing", lambda past, *_: past)
    without = FOOTAGE.start(tmp_path / "scene")
    assert play(without, range(1, 6), APART_BY)[-1].timing == {}
    here, there = (scene.history.gaussians(5).arrays() for scene in (without, undisturbed[0]))
    assert all(np.array_equal(here[name], there[name]) for name in here)


class Noted:
    """The arguments of ``timing.record_timing`` in one frame, to be changed."""

    def __init__(self, scene: Reconstruction, monkeypatch: pytest.MonkeyPatch) -> None:
        looked, found = timing.record_timing, list[tuple]()
        monkeypatch.setattr(timing, "record_timing", lambda *given: found.append(given) or looked(*given))
        play(scene, range(1, 2), {})  # of that one nothing is told: no motion led it
        play(scene, range(2, 3), {})
        self.given, self.looked = found[-1], looked

    def looks(self, past: Past | None = None, **result: object) -> Past:
        known, before, solved, *more = self.given
        return self.looked(past or known, before, replace(solved, **result), *more)


def test_frames_and_cameras_that_are_not_believed_say_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    noted = Noted(FOOTAGE.start(tmp_path / "scene"), monkeypatch)
    past, _, result = noted.given[:3]
    seen = [name for name, row in noted.looks().timing.items() if CameraTimingSums(*row).weight]
    assert len(seen) == 2  # 60 iterations
    assert noted.looks() is not past
    for silent in (
        {"outcome": FrameOutcome.REJECTED_MISFIT},
        {"outcome": FrameOutcome.RELOCATED},
        {"exposure": 1.1},
        {"attempts": ["as set", "longer search"]},
        {"trace": replace(result.trace, kept=Candidate.PREVIOUS)},
        {"trace": replace(result.trace, shown={})},  # as on a GPU
    ):
        assert noted.looks(**silent) is past
    out = replace(past, frames_left_out={**past.frames_left_out, seen[0]: 1})
    assert seen[0] not in noted.looks(out).timing
    left_out = replace(result.trace, left_out={seen[1]: "it does not fit"})
    assert seen[1] not in noted.looks(trace=left_out).timing


def test_others_are_looked_at_in_each_frame(undisturbed: tuple[Reconstruction, list[FrameReport]]) -> None:
    rows = undisturbed[0]._prepared.carried.past.timing
    assert rows.keys() == set(FOOTAGE.rig.names)
    assert min(CameraTimingSums(*row).last for row in rows.values()) >= 10


def test_moments_move_what_moves_alone() -> None:
    one = Gaussians.of_points([[0, 0, 2], [1, 0, 2]], radius=0.1, colours=[1, 0, 0])
    before = one.replace(foreground=np.float32([1, 0]))
    now = before.replace(means=before.means + np.float32([[0.2, 0, 0], [0, 0, 0]]), factors=2 * before.factors)
    ahead, back = (extrapolated(before, now, share) for share in (0.5, -0.5))
    np.testing.assert_allclose(ahead.means[0], [0.3, 0, 2], atol=1e-6)
    np.testing.assert_allclose(back.means[0], [0.1, 0, 2], atol=1e-6)
    np.testing.assert_allclose(ahead.factors[0], 2.5 * before.factors[0], atol=1e-6)
    assert np.array_equal(ahead.factors[1], now.factors[1])


def test_the_synthetic_footage_is_rendered_at_any_moment() -> None:
    footage = SyntheticFootage()
    frame, later = footage.frame(3), footage.frame(4)
    shown = shown_out_of_step(footage, 3, {"c1": 1.0, "c2": 0.0})
    assert np.array_equal(shown.images["c0"], frame.images["c0"])
    assert np.array_equal(shown.masks["c1"], later.masks["c1"])
    assert np.array_equal(shown.masks["c2"], frame.masks["c2"])
    difference = shown.images["c1"].astype(float) - later.images["c1"]
    assert difference.std() == pytest.approx(np.sqrt(2) * 3, rel=0.3)  # noise of its own alone
