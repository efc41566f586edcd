"""Which pictures are believed: brightness, places among the cameras, levels, and what is usual afterwards."""

from __future__ import annotations

from dataclasses import replace
from math import isnan, nan

import numpy as np
import pytest

from scas4d_core.robust import outliers as judge
from scas4d_core.robust.outliers import CameraPast, Past

NAMES = [f"c{k}" for k in range(10)]
LEVEL = 33.0
PLACES = {name: 0.3 * k - 1.35 for k, name in enumerate(NAMES)}
PAST = Past({n: CameraPast(PLACES[n], 0.2 + 0.01 * k, 0) for k, n in enumerate(NAMES)}, LEVEL, 5, 0, 1.0)
USUAL = {name: LEVEL + place for name, place in PLACES.items()}
BRIGHT = {name: past.brightness for name, past in PAST.cameras.items()}


def times(factor: float, *names: str) -> dict[str, float]:
    """The brightness of the cameras, of some of them times a factor."""
    return {name: value * (factor if not names or name in names else 1) for name, value in BRIGHT.items()}


def test_usual_pictures_are_believed() -> None:
    assert judge.look(PAST, BRIGHT) == judge.Look()


@pytest.mark.parametrize("factor", [0.0, 0.3, 3.0])
def test_another_light_holds_the_frame_and_says_how_bright_it_is(factor: float) -> None:
    held = judge.look(PAST, times(factor)).held
    assert held is not None
    assert f"{factor:.2g} times as bright" in held


@pytest.mark.parametrize(("factor", "exposure"), [(1.03, 1.0), (0.97, 1.0), (1.3, 1.3), (0.75, 0.75)])
def test_exposure_is_the_median_of_the_cameras_once_it_is_told_from_noise(factor: float, exposure: float) -> None:
    found = judge.look(PAST, times(factor))
    assert found.held is None
    assert found.exposure == pytest.approx(exposure)


def test_few_cameras_tell_no_exposure_but_a_black_frame() -> None:
    few = {name: BRIGHT[name] for name in NAMES[: judge.ENOUGH - 1]}
    assert judge.look(PAST, {name: 1.4 * value for name, value in few.items()}).exposure == 1.0
    assert judge.look(PAST, {name: 3 * value for name, value in few.items()}).held is None
    assert judge.look(PAST, dict.fromkeys(few, 0.0)).held is not None


def test_a_camera_that_shows_nothing_is_left_out_against_the_others_not_against_the_light() -> None:
    assert list(judge.look(PAST, times(0.01, "c3")).left_out) == ["c3"]
    assert list(judge.look(PAST, times(0.6)).left_out) == []
    assert list(judge.look(PAST, {**times(0.6), "c3": 0.001}).left_out) == ["c3"]


def test_where_most_cameras_show_nothing_none_is_left_out() -> None:
    half = judge.look(PAST, times(0.01, *NAMES[:4]))
    assert sorted(half.left_out) == NAMES[:4]
    assert judge.look(replace(PAST, cameras={**PAST.cameras}), times(0.01, *NAMES[:6])).held is not None


def test_brightness_looks_at_every_fourth_pixel_and_not_at_shadows_of_dark_pictures() -> None:
    picture = np.zeros((16, 16, 3), np.uint8)
    picture[::4, ::4] = 255
    assert judge.brightness_of(picture) == 1.0
    dark = Past({"c0": CameraPast(0.0, judge.DARKEST / 2, 0)}, LEVEL, 3)
    assert judge.look(dark, {"c0": 0.5}).held is None


@pytest.mark.parametrize("shift", [-4.0, 0.0, 3.0])
def test_places_do_not_depend_on_the_level_of_the_frame(shift: float) -> None:
    found = judge.place(PAST, {name: value + shift for name, value in USUAL.items()})
    np.testing.assert_allclose(list(found.values()), 0, atol=1e-9)


def test_a_camera_that_fits_worse_than_usual_is_a_misfit_in_any_place() -> None:
    for name in NAMES:
        psnr = {**USUAL, name: USUAL[name] + judge.FIRST_DB - 1}
        assert list(judge.misfits(PAST, psnr, judge.FIRST_DB)) == [name]
        assert judge.misfits(PAST, {**USUAL, name: USUAL[name] + judge.FIRST_DB + 1}, judge.FIRST_DB) == {}


def test_more_is_allowed_for_before_the_first_update() -> None:
    psnr = {**USUAL, "c2": USUAL["c2"] + judge.FIRST_DB - 1}
    assert judge.misfits(replace(PAST, updates=0), psnr, judge.FIRST_DB) == {}
    psnr["c2"] += judge.NEW_DB
    assert list(judge.misfits(replace(PAST, updates=0), psnr, judge.FIRST_DB)) == ["c2"]


def test_where_most_do_not_fit_it_is_the_frame() -> None:
    psnr = {name: value - (15 if name in NAMES[:6] else 0) for name, value in USUAL.items()}
    assert len(judge.misfits(PAST, psnr, judge.FIRST_DB)) <= judge.MOST_OUT * len(NAMES)


def test_an_update_has_met_its_frame_or_says_by_how_much_not() -> None:
    assert judge.unmet(PAST, USUAL) is None
    assert judge.unmet(PAST, {n: v - judge.DROP_DB + 0.1 for n, v in USUAL.items()}) is None
    why = judge.unmet(PAST, {n: v - judge.DROP_DB - 0.5 for n, v in USUAL.items()})
    assert why is not None
    assert f"{judge.DROP_DB + 0.5:.1f} dB less than usual" in why
    assert judge.unmet(replace(PAST, level=nan), dict.fromkeys(USUAL, 5.0)) is None
    assert judge.unmet(PAST, {}) is None


def test_an_update_of_fewer_iterations_may_meet_its_frame_less_well() -> None:
    past = judge.settle(PAST, USUAL, BRIGHT, 1.0, 100)
    assert past.iterations == 100
    worse = {name: value - judge.DROP_DB - 1.5 * judge.HALVED_DB for name, value in USUAL.items()}
    assert judge.unmet(past, worse, 100) is not None
    assert judge.unmet(past, worse, 50) is not None
    assert judge.unmet(past, worse, 25) is None
    assert judge.unmet(past, worse, 200) is not None
    assert judge.settle(past, USUAL, BRIGHT, 1.0).iterations == 100
    assert Past.of_arrays(past.arrays()) == past


def test_above_clean_pictures_differences_are_no_sign_of_a_fault() -> None:
    cameras = {name: CameraPast(0.0, past.brightness, 0) for name, past in PAST.cameras.items()}
    past = replace(PAST, cameras=cameras, level=55.0)
    psnr = {**dict.fromkeys(USUAL, 55.0), "c1": 42.0}
    settled = judge.settle(past, psnr, BRIGHT, 1.0)
    assert not any(camera.out for camera in settled.cameras.values())
    clean = judge.settle(Past(), psnr, BRIGHT, 1.0)
    assert clean.level == judge.CLEAN_DB
    assert judge.unmet(clean, dict.fromkeys(USUAL, 47.0)) is None


def test_health_falls_from_one_to_nothing_where_a_camera_is_left_out() -> None:
    assert [judge.health(off) for off in (None, 2.0, 0.0, judge.LAST_DB / 2, judge.LAST_DB, -30.0)] == [
        1.0, 1.0, 1.0, 0.5, 0.0, 0.0,
    ]  # fmt: skip


def test_a_camera_that_ends_badly_is_out_from_the_next_frame_and_comes_back_once_it_fits() -> None:
    bad = {**USUAL, "c4": USUAL["c4"] + judge.LAST_DB - 1}
    past = judge.settle(PAST, bad, BRIGHT, 1.0)
    assert [name for name, camera in past.cameras.items() if camera.out] == ["c4"]
    assert list(judge.look(past, BRIGHT).left_out) == ["c4"]
    again = judge.settle(past, bad, BRIGHT, 1.0)
    assert again.of("c4").out == 2
    assert again.of("c4").place == PAST.of("c4").place
    back = judge.settle(again, {**USUAL, "c4": USUAL["c4"] + judge.FITS_DB + 0.5}, BRIGHT, 1.0)
    assert back.of("c4").out == 0
    unseen = judge.settle(again, {name: value for name, value in USUAL.items() if name != "c4"}, BRIGHT, 1.0)
    assert unseen.of("c4").out == 3


def test_a_camera_that_shows_nothing_is_seen_to_for_as_long_as_it_does() -> None:
    black = times(0.0, "c3")
    past = judge.settle(PAST, {name: value for name, value in USUAL.items() if name != "c3"}, black, 1.0)
    assert past.of("c3") == PAST.of("c3")
    assert list(judge.look(past, black).left_out) == ["c3"]


@pytest.mark.parametrize("name", ["c0", "c9"])
def test_an_update_that_renders_one_camera_says_as_much_as_one_that_renders_all(name: str) -> None:
    cameras = {n: replace(camera, place=3 * camera.place) for n, camera in PAST.cameras.items()}
    past = replace(PAST, cameras=cameras)
    only = {name: LEVEL + cameras[name].place}
    assert abs(cameras[name].place) > 4
    assert judge.behind(replace(past, held=1), only) is None
    after = judge.settle(past, only, BRIGHT, 1.0)
    assert after.level == pytest.approx(LEVEL)
    assert after.of(name).place == pytest.approx(cameras[name].place)
    assert judge.unmet(past, {name: only[name] - judge.DROP_DB - 0.5}) is not None


def test_cameras_that_are_out_are_held_against_those_that_are_believed() -> None:
    out = NAMES[:5]
    cameras = {n: replace(camera, out=int(n in out)) for n, camera in PAST.cameras.items()}
    psnr = {n: value - 5 * (n in out) for n, value in USUAL.items()}
    past = judge.settle(replace(PAST, cameras=cameras), psnr, BRIGHT, 1.0)
    assert [past.of(name).out for name in NAMES] == [2] * 5 + [0] * 5


def test_at_most_half_of_the_cameras_are_left_out_in_the_dark_too() -> None:
    dark = Past({name: CameraPast(0.0, 0.0, 1) for name in NAMES}, LEVEL, 3)
    assert judge.look(dark, BRIGHT).left_out == {}


def test_what_is_usual_follows_slowly_and_not_what_was_left_out() -> None:
    better = judge.settle(PAST, {name: value + 2 for name, value in USUAL.items()}, times(1.2), 1.2)
    assert better.level == pytest.approx(LEVEL + judge.LEVEL_RATE * 2)
    assert better.of("c0").brightness == pytest.approx(BRIGHT["c0"])
    assert (better.updates, better.held) == (PAST.updates + 1, 0)
    one = judge.settle(PAST, {**USUAL, "c0": USUAL["c0"] - 3}, BRIGHT, 1.0)
    assert PLACES["c0"] - 3 * judge.PLACE_RATE - 0.2 < one.of("c0").place < PLACES["c0"]


def test_a_camera_that_was_not_there_keeps_its_past_and_a_new_one_gets_its_own() -> None:
    seen = {name: value for name, value in USUAL.items() if name != "c1"} | {"new": LEVEL}
    bright = {name: value for name, value in BRIGHT.items() if name != "c1"} | {"new": 0.3}
    past = judge.settle(PAST, seen, bright, 1.0)
    assert past.of("c1") == PAST.of("c1")
    assert past.of("new").brightness == 0.3
    assert not isnan(past.of("new").place)


def test_the_past_goes_through_arrays_unchanged() -> None:
    past = replace(PAST, held=3, error={"c0": 0.02, "c5": 0.03}, cameras={**PAST.cameras, "x": CameraPast(out=2)})
    back = Past.of_arrays(past.arrays())
    assert repr(back) == repr(past)
    assert repr(Past.of_arrays({})) == repr(Past())
    with pytest.raises(KeyError):
        Past.of_arrays({"names": np.array(["c0"])})
    broken = {**past.arrays(), "names": np.array(["c0"])}
    with pytest.raises(ValueError, match=r"zip|argument"):
        Past.of_arrays(broken)
