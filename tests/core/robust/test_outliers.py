"""Cameras and frames that are believed: brightness, offsets among the cameras, levels, and the past afterwards."""

from __future__ import annotations

from dataclasses import replace
from math import isnan, nan

import numpy as np
import pytest

from scas4d_core.robust import checks, outliers
from scas4d_core.robust.checks import check_brightness
from scas4d_core.robust.outliers import Past

NAMES = [f"c{k}" for k in range(10)]
LEVEL = 33.0
PLACES = {name: 0.3 * k - 1.35 for k, name in enumerate(NAMES)}
BRIGHT = {name: 0.2 + 0.01 * k for k, name in enumerate(NAMES)}
PAST = Past(PLACES, BRIGHT, dict.fromkeys(NAMES, 0), LEVEL, 5, 0, 1.0)
USUAL = {name: LEVEL + place for name, place in PLACES.items()}


def times(factor: float, *names: str) -> dict[str, float]:
    """The brightness of the cameras, of some of them times a factor."""
    return {name: value * (factor if not names or name in names else 1) for name, value in BRIGHT.items()}


def figures(past: Past, name: str) -> tuple[float, float, int]:
    return past.camera_levels[name], past.brightness[name], past.frames_left_out[name]


def test_usual_pictures_are_believed() -> None:
    assert check_brightness(PAST, BRIGHT) == (1.0, {}, None)


@pytest.mark.parametrize("factor", [0.0, 0.3, 3.0])
def test_another_light_holds_the_frame_and_says_how_bright_it_is(factor: float) -> None:
    _, _, unusable = check_brightness(PAST, times(factor))
    assert unusable is not None
    assert f"{factor:.2g} times as bright" in unusable


@pytest.mark.parametrize(("factor", "exposure"), [(1.03, 1.0), (0.97, 1.0), (1.3, 1.3), (0.75, 0.75)])
def test_exposure_is_the_median_of_the_cameras_once_it_is_told_from_noise(factor: float, exposure: float) -> None:
    found, _, unusable = check_brightness(PAST, times(factor))
    assert unusable is None
    assert found == pytest.approx(exposure)


def test_few_cameras_tell_no_exposure_but_a_black_frame() -> None:
    few = {name: BRIGHT[name] for name in NAMES[: checks.ENOUGH - 1]}
    assert check_brightness(PAST, {name: 1.4 * value for name, value in few.items()})[0] == 1.0
    assert check_brightness(PAST, {name: 3 * value for name, value in few.items()})[2] is None
    assert check_brightness(PAST, dict.fromkeys(few, 0.0))[2] is not None


def test_a_camera_that_shows_nothing_is_left_out_against_the_others_not_against_the_light() -> None:
    assert list(check_brightness(PAST, times(0.01, "c3"))[1]) == ["c3"]
    assert list(check_brightness(PAST, times(0.6))[1]) == []
    assert list(check_brightness(PAST, {**times(0.6), "c3": 0.001})[1]) == ["c3"]


def test_where_most_cameras_show_nothing_none_is_left_out() -> None:
    _, left_out, _ = check_brightness(PAST, times(0.01, *NAMES[:4]))
    assert sorted(left_out) == NAMES[:4]
    assert check_brightness(PAST, times(0.01, *NAMES[:6]))[2] is not None


def test_brightness_looks_at_every_fourth_pixel_and_not_at_shadows_of_dark_pictures() -> None:
    picture = np.zeros((16, 16, 3), np.uint8)
    picture[::4, ::4] = 255
    assert checks.brightness_of(picture) == 1.0
    dark = Past({"c0": 0.0}, {"c0": checks.DARKEST / 2}, {"c0": 0}, LEVEL, 3)
    assert check_brightness(dark, {"c0": 0.5})[2] is None


@pytest.mark.parametrize("shift", [-4.0, 0.0, 3.0])
def test_places_do_not_depend_on_the_level_of_the_frame(shift: float) -> None:
    found = outliers.offsets(PAST, {name: value + shift for name, value in USUAL.items()})
    np.testing.assert_allclose(list(found.values()), 0, atol=1e-9)


def test_a_camera_that_fits_worse_than_usual_is_a_misfit_in_any_place() -> None:
    for name in NAMES:
        psnr = {**USUAL, name: USUAL[name] + outliers.FIRST_DB - 1}
        assert list(outliers.misfits(PAST, psnr, outliers.FIRST_DB)) == [name]
        assert outliers.misfits(PAST, {**USUAL, name: USUAL[name] + outliers.FIRST_DB + 1}, outliers.FIRST_DB) == {}


def test_more_is_allowed_for_before_the_first_update() -> None:
    psnr = {**USUAL, "c2": USUAL["c2"] + outliers.FIRST_DB - 1}
    assert outliers.misfits(replace(PAST, updates=0), psnr, outliers.FIRST_DB) == {}
    psnr["c2"] += outliers.NEW_DB[0]
    assert list(outliers.misfits(replace(PAST, updates=0), psnr, outliers.FIRST_DB)) == ["c2"]


def test_where_most_do_not_fit_it_is_the_frame() -> None:
    psnr = {name: value - (15 if name in NAMES[:6] else 0) for name, value in USUAL.items()}
    assert len(outliers.misfits(PAST, psnr, outliers.FIRST_DB)) <= outliers.MAX_OUT * len(NAMES)


def test_an_update_has_met_its_frame_or_says_by_how_much_not() -> None:
    assert outliers.misfit_reason(PAST, USUAL) is None
    assert outliers.misfit_reason(PAST, {n: v - outliers.DROP_DB + 0.1 for n, v in USUAL.items()}) is None
    why = outliers.misfit_reason(PAST, {n: v - outliers.DROP_DB - 0.5 for n, v in USUAL.items()})
    assert why is not None
    assert f"{outliers.DROP_DB + 0.5:.1f} dB less than usual" in why
    assert outliers.misfit_reason(replace(PAST, level=nan), dict.fromkeys(USUAL, 5.0)) is None
    assert outliers.misfit_reason(PAST, {}) is None


def test_an_update_of_fewer_iterations_may_meet_its_frame_less_well() -> None:
    past = outliers.past_after_update(PAST, USUAL, BRIGHT, 1.0, 100)
    assert past.iterations == 100
    worse = {name: value - outliers.DROP_DB - 1.5 * outliers.HALVED_DB for name, value in USUAL.items()}
    assert outliers.misfit_reason(past, worse, 100) is not None
    assert outliers.misfit_reason(past, worse, 50) is not None
    assert outliers.misfit_reason(past, worse, 25) is None
    assert outliers.misfit_reason(past, worse, 200) is not None
    assert outliers.past_after_update(past, USUAL, BRIGHT, 1.0).iterations == 100
    assert Past.of_arrays(past.arrays()) == past


def test_above_clean_pictures_differences_are_no_sign_of_a_fault() -> None:
    past = replace(PAST, camera_levels=dict.fromkeys(NAMES, 0.0), level=55.0)
    psnr = {**dict.fromkeys(USUAL, 55.0), "c1": 42.0}
    settled = outliers.past_after_update(past, psnr, BRIGHT, 1.0)
    assert not any(settled.frames_left_out.values())
    clean = outliers.past_after_update(Past(), psnr, BRIGHT, 1.0)
    assert clean.level == outliers.CLEAN_DB
    assert outliers.misfit_reason(clean, dict.fromkeys(USUAL, 47.0)) is None


def test_health_falls_from_one_to_nothing_where_a_camera_is_left_out() -> None:
    offs = (2.0, 0.0, outliers.LAST_DB / 2, outliers.LAST_DB, -30.0)
    assert [outliers.health(PAST, off) for off in offs] == [1.0, 1.0, 0.5, 0.0, 0.0]


@pytest.mark.parametrize("updates", range(len(outliers.NEW_DB)))
def test_health_allows_for_places_that_are_hardly_known(updates: int) -> None:
    new, limit = replace(PAST, updates=updates), outliers.LAST_DB + outliers.NEW_DB[updates]
    for name in NAMES:
        psnr = {**USUAL, name: USUAL[name] + limit - 0.1}
        assert outliers.health(new, limit) == 0.0 < outliers.health(new, outliers.LAST_DB)
        assert list(outliers.misfits(new, psnr, outliers.LAST_DB)) == [name]
        assert outliers.misfits(new, {**USUAL, name: USUAL[name] + outliers.LAST_DB}, outliers.LAST_DB) == {}


def test_a_camera_that_ends_badly_is_out_from_the_next_frame_and_comes_back_once_it_fits() -> None:
    bad = {**USUAL, "c4": USUAL["c4"] + outliers.LAST_DB - 1}
    past = outliers.past_after_update(PAST, bad, BRIGHT, 1.0)
    assert [name for name, out in past.frames_left_out.items() if out] == ["c4"]
    assert list(check_brightness(past, BRIGHT)[1]) == ["c4"]
    again = outliers.past_after_update(past, bad, BRIGHT, 1.0)
    assert again.frames_left_out["c4"] == 2
    assert again.camera_levels["c4"] == PAST.camera_levels["c4"]
    back = outliers.past_after_update(again, {**USUAL, "c4": USUAL["c4"] + outliers.FITS_DB + 0.5}, BRIGHT, 1.0)
    assert back.frames_left_out["c4"] == 0
    unseen = outliers.past_after_update(
        again, {name: value for name, value in USUAL.items() if name != "c4"}, BRIGHT, 1.0
    )
    assert unseen.frames_left_out["c4"] == 3


def test_a_camera_that_shows_nothing_is_seen_to_for_as_long_as_it_does() -> None:
    black = times(0.0, "c3")
    past = outliers.past_after_update(PAST, {name: value for name, value in USUAL.items() if name != "c3"}, black, 1.0)
    assert figures(past, "c3") == figures(PAST, "c3")
    assert list(check_brightness(past, black)[1]) == ["c3"]


@pytest.mark.parametrize("name", ["c0", "c9"])
def test_an_update_that_renders_one_camera_says_as_much_as_one_that_renders_all(name: str) -> None:
    places = {n: 3 * place for n, place in PLACES.items()}
    past = replace(PAST, camera_levels=places)
    only = {name: LEVEL + places[name]}
    assert abs(places[name]) > 4
    assert outliers.lag_reason(replace(past, rejected=1), only) is None
    after = outliers.past_after_update(past, only, BRIGHT, 1.0)
    assert after.level == pytest.approx(LEVEL)
    assert after.camera_levels[name] == pytest.approx(places[name])
    assert outliers.misfit_reason(past, {name: only[name] - outliers.DROP_DB - 0.5}) is not None


def test_cameras_that_are_out_are_held_against_those_that_are_believed() -> None:
    out = NAMES[:5]
    outs = {name: int(name in out) for name in NAMES}
    psnr = {n: value - 5 * (n in out) for n, value in USUAL.items()}
    past = outliers.past_after_update(replace(PAST, frames_left_out=outs), psnr, BRIGHT, 1.0)
    assert [past.frames_left_out[name] for name in NAMES] == [2] * 5 + [0] * 5


def test_at_most_half_of_the_cameras_are_left_out_in_the_dark_too() -> None:
    dark = Past(dict.fromkeys(NAMES, 0.0), dict.fromkeys(NAMES, 0.0), dict.fromkeys(NAMES, 1), LEVEL, 3)
    assert check_brightness(dark, BRIGHT)[1] == {}


def test_what_is_usual_follows_slowly_and_not_what_was_left_out() -> None:
    better = outliers.past_after_update(PAST, {name: value + 2 for name, value in USUAL.items()}, times(1.2), 1.2)
    assert better.level == pytest.approx(LEVEL + outliers.LEVEL_RATE * 2)
    assert better.brightness["c0"] == pytest.approx(BRIGHT["c0"])
    assert (better.updates, better.rejected) == (PAST.updates + 1, 0)
    one = outliers.past_after_update(PAST, {**USUAL, "c0": USUAL["c0"] - 3}, BRIGHT, 1.0)
    assert PLACES["c0"] - 3 * outliers.PLACE_RATE - 0.2 < one.camera_levels["c0"] < PLACES["c0"]


def test_an_update_that_changed_nothing_tells_nothing_of_updates() -> None:
    """The frame after a first update that kept the state may still be met far less well than frame 0 was."""
    new = replace(PAST, updates=0)
    same, other = (outliers.past_after_update(new, USUAL, BRIGHT, 1.0, moved=moved) for moved in (False, True))
    worse = {name: value - (outliers.DROPS_DB[0] + outliers.DROPS_DB[1]) / 2 for name, value in USUAL.items()}
    assert outliers.misfit_reason(same, worse) is None
    assert outliers.misfit_reason(other, worse) is not None


def test_a_camera_that_was_not_there_keeps_its_past_and_a_new_one_gets_its_own() -> None:
    seen = {name: value for name, value in USUAL.items() if name != "c1"} | {"new": LEVEL}
    bright = {name: value for name, value in BRIGHT.items() if name != "c1"} | {"new": 0.3}
    past = outliers.past_after_update(PAST, seen, bright, 1.0)
    assert figures(past, "c1") == figures(PAST, "c1")
    assert past.brightness["new"] == 0.3
    assert not isnan(past.camera_levels["new"])


def test_the_past_goes_through_arrays_unchanged() -> None:
    past = replace(PAST, rejected=3, error={"c0": 0.02, "c5": 0.03}, camera_levels={**PLACES, "x": nan})
    past = replace(past, brightness={**BRIGHT, "x": nan}, frames_left_out={**PAST.frames_left_out, "x": 2})
    back = Past.of_arrays(past.arrays())
    assert repr(back) == repr(past)
    assert repr(Past.of_arrays(Past().arrays())) == repr(Past())
    with pytest.raises(KeyError):
        Past.of_arrays({"names": np.array(["c0"])})
    broken = {**past.arrays(), "names": np.array(["c0"])}
    with pytest.raises(ValueError, match=r"zip|argument"):
        Past.of_arrays(broken)


@pytest.mark.parametrize(("off", "follows"), [(-3.4, True), (-3.6, False)])
def test_the_usual_place_of_a_camera_does_not_follow_what_is_in_doubt(off: float, follows: bool) -> None:
    """Else a fault that lasts is usual before two frames in a row have told of it."""
    after = outliers.past_after_update(PAST, {**USUAL, "c4": USUAL["c4"] + off}, BRIGHT, 1.0)
    wanted = PLACES["c4"] + (outliers.PLACE_RATE * off if follows else 0.0)
    assert after.camera_levels["c4"] == pytest.approx(wanted)
    assert after.frames_left_out["c4"] == 0


@pytest.mark.parametrize("updates", [0, 1])
def test_a_place_that_is_hardly_known_follows_all_the_same(updates: int) -> None:
    past = replace(PAST, updates=updates)
    after = outliers.past_after_update(past, {**USUAL, "c4": USUAL["c4"] - 4.5}, BRIGHT, 1.0)
    assert after.camera_levels["c4"] < PLACES["c4"] - 0.5
