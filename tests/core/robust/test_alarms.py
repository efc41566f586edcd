"""Alarms: told from a camera's own past and the others of the frame, and not from what all see together."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from math import isnan, nan
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from frame_cases.footage import SyntheticFootage

from scas4d_core.captures.frame import Frame
from scas4d_core.effect_names import EFFECTS
from scas4d_core.frame_outcome import Alarm, AlarmKind, FrameOutcome
from scas4d_core.robust import alarms, outliers
from scas4d_core.robust.alarms import (
    BRIGHTNESS,
    CAMERA_GAIN,
    DARKEST,
    DIRT_ROW,
    GAIN,
    SHARPNESS,
    TINT,
    CameraFigures,
    Numbers,
    alarms_of,
    left_out_alarms,
    log_gains,
    mean_differences,
)
from scas4d_core.robust.lens_dirt import SHARE, STATIC_SHARE, ShiftedRegion
from scas4d_core.robust.outliers import LAST_DB, NEAR_DB, NEW_DB, Past

NAMES = [f"c{k}" for k in range(10)]
SHARP = dict.fromkeys(NAMES, -0.3)
GREY = {name: np.full(3, 0.01 * k) for k, name in enumerate(NAMES)}
NONE = dict.fromkeys(NAMES, 0.0)


def never(name: str) -> ShiftedRegion:
    raise AssertionError(f"the image of {name} was searched")


def settled(past: Past, **changes: Any) -> tuple[list[Alarm], Past]:
    given: dict[str, Any] = {
        "outcome": FrameOutcome.UPDATED, "reason": "", "exposure": 1.0, "offsets": NONE, "colours": GREY,
        "sharp": SHARP, "same": (), "gains": (GREY, GREY), "differences": NONE, "region": never, **changes,
    }  # fmt: skip
    return alarms_of(past, past, **given)


@pytest.fixture
def past() -> Past:
    new = Past(dict.fromkeys(NAMES, 0.0), dict.fromkeys(NAMES, 0.3), dict.fromkeys(NAMES, 0), 33.0, 5)
    found, known = settled(new)
    assert found == []
    return known


def kinds_of(found: Collection[Alarm]) -> list[tuple[str, str | None]]:
    return [(alarm.kind.value, alarm.camera) for alarm in found]


def in_a_row(past: Past, frames: int = 4, **changes: Any) -> list[list[tuple[str, str | None]]]:
    rows = []
    for _ in range(frames):
        found, past = settled(past, **changes)
        rows.append(kinds_of(found))
    return rows


def test_usual_figures_raise_no_alarm(past: Past) -> None:
    assert in_a_row(past) == [[]] * 4


def test_a_camera_that_will_be_left_out_raises_one_at_once_and_one_in_doubt_after_two_frames(past: Past) -> None:
    misfit = [("camera_misfit", "c3")]
    assert in_a_row(past, offsets={**NONE, "c3": LAST_DB - 0.1}) == [misfit] * 4
    assert in_a_row(past, offsets={**NONE, "c3": NEAR_DB - 0.1}) == [[], misfit, misfit, misfit]
    assert in_a_row(past, offsets={**NONE, "c3": NEAR_DB + 0.1}) == [[]] * 4


def test_one_frame_of_doubt_between_good_ones_is_noise(past: Past) -> None:
    for _ in range(3):
        found, past = settled(past, offsets={**NONE, "c3": NEAR_DB - 0.5})
        assert found == []
        found, past = settled(past)
        assert found == []


def test_all_cameras_that_fall_together_raise_no_alarm(past: Past) -> None:
    psnr = {name: 33.0 - 13.5 for name in NAMES}
    assert in_a_row(past, offsets=outliers.offsets(past, psnr)) == [[]] * 4
    assert in_a_row(past, offsets={name: 3 * LAST_DB for name in NAMES[:6]} | dict.fromkeys(NAMES[6:], 0.0)) == [[]] * 4


@pytest.mark.parametrize("updates", range(len(NEW_DB)))
def test_the_usual_spread_of_the_first_updates_raises_none(updates: int) -> None:
    new = Past(dict.fromkeys(NAMES, 0.0), dict.fromkeys(NAMES, 0.3), dict.fromkeys(NAMES, 0), 33.0, updates)
    off = LAST_DB + NEW_DB[updates]
    assert kinds_of(settled(new, offsets={**NONE, "c3": LAST_DB})[0]) == []
    assert kinds_of(settled(new, offsets={**NONE, "c3": off - 0.1})[0]) == [("camera_misfit", "c3")]


def coloured(change: Mapping[str, tuple[float, float, float]]) -> dict[str, Numbers]:
    return {name: grey + np.array(change.get(name, (0, 0, 0))) for name, grey in GREY.items()}


def test_a_cast_of_one_camera_raises_an_alarm_and_a_light_that_all_see_none(past: Past) -> None:
    cast = [("camera_colours", "c3")]
    assert in_a_row(past, colours=coloured({"c3": (TINT[1] + 0.01, 0, 0)})) == [cast] * 4
    assert in_a_row(past, colours=coloured({"c3": (0, TINT[0] + 0.02, 0)})) == [[], cast, cast, cast]
    assert in_a_row(past, colours=coloured({"c3": (0, 0, TINT[0] - 0.02)})) == [[]] * 4
    assert in_a_row(past, colours=coloured(dict.fromkeys(NAMES, (0.4, 0.1, -0.2)))) == [[]] * 4


def test_more_is_allowed_for_where_all_colours_change_as_where_a_thing_is_seen_from_its_edge(past: Past) -> None:
    assert in_a_row(past, colours=coloured({"c3": (GAIN[0] - 0.01,) * 3})) == [[]] * 4
    found, after = settled(past, colours=coloured({"c3": (-GAIN[1] - 0.01,) * 3}))
    assert kinds_of(found) == [("camera_colours", "c3")]
    assert "darker" in found[0].evidence
    assert kinds_of(settled(after)[0]) == []


def test_where_all_colours_are_met_badly_one_cameras_say_little(past: Past) -> None:
    rough = {name: (0.06 * (-1) ** k, 0, -0.06 * (-1) ** k) for k, name in enumerate(NAMES)}
    cast = {"c3": (0.2, 0, 0)}
    assert kinds_of(settled(past, colours=coloured({**rough, **cast}))[0]) == []
    assert kinds_of(settled(past, colours=coloured(cast))[0]) == [("camera_colours", "c3")]
    assert kinds_of(settled(past, colours=coloured({**rough, "c3": (0.9, 0, 0)}))[0]) == [("camera_colours", "c3")]


def test_colours_that_drift_slowly_are_followed(past: Past) -> None:
    for k in range(40):
        found, past = settled(past, colours=coloured({"c3": (0.005 * k, 0, 0)}))
        assert found == []


@pytest.mark.parametrize(("sign", "word"), [(-1, "less sharp"), (1, "sharper")])
def test_a_camera_that_loses_its_focus_or_gets_noisy_raises_an_alarm(past: Past, sign: int, word: str) -> None:
    kind = [("camera_sharpness", "c3")]
    found, _ = settled(past, sharp={**SHARP, "c3": -0.3 + sign * (SHARPNESS[1] + 0.01)})
    assert kinds_of(found) == kind
    assert word in found[0].evidence
    assert in_a_row(past, sharp={**SHARP, "c3": -0.3 + sign * (SHARPNESS[0] + 0.01)}) == [[], kind, kind, kind]
    assert in_a_row(past, sharp={name: value + sign for name, value in SHARP.items()}) == [[]] * 4
    assert in_a_row(past, sharp={**SHARP, "c3": nan}) == [[]] * 4


def test_a_camera_that_sends_its_picture_again_while_the_others_go_on(past: Past) -> None:
    assert in_a_row(past, same=["c3"]) == [[], *[[("camera_frozen", "c3")]] * 3]
    assert in_a_row(past, same=NAMES[:6]) == [[]] * 4
    assert in_a_row(past, same=NAMES, offsets={}) == [[("frame_repeated", None)]] * 4


def test_alarms_of_the_frame_are_no_cameras(past: Past) -> None:
    wild = {"offsets": {**NONE, "c3": -20.0}, "reason": "too dark"}
    found, after = settled(past, outcome=FrameOutcome.REJECTED_UNUSABLE, **wild)
    assert kinds_of(found) == [("frame_rejected", None)]
    assert found[0].evidence == "previous state kept: too dark"
    assert after == past
    assert kinds_of(settled(past, outcome=FrameOutcome.RELOCATED, reason="far")[0]) == [("frame_in_part", None)]
    assert kinds_of(settled(past, exposure=1.3)[0]) == [("light", None)]
    assert kinds_of(settled(past, outcome=FrameOutcome.UNCHANGED, offsets={})[0]) == []


def test_a_camera_that_was_left_out_has_that_alarm_alone_unless_it_is_frozen(past: Past) -> None:
    assert settled(past, offsets={**NONE, "c3": -20.0}, left_out=["c3"])[0] == []
    frozen = in_a_row(past, 4, same=["c3"], offsets={**NONE, "c3": -20.0}, left_out=["c3"])
    assert frozen == [[], [("camera_frozen", "c3")], [("camera_frozen", "c3")], [("camera_frozen", "c3")]]
    found = left_out_alarms(["a", "b", "c"], ["a", "b"], {"b": "it shows nothing"})
    assert [(alarm.kind, alarm.camera) for alarm in found] == [
        (AlarmKind.CAMERA_LEFT_OUT, "b"), (AlarmKind.CAMERA_LEFT_OUT, "c"),
    ]  # fmt: skip
    assert "it shows nothing" in found[0].evidence
    assert "no image was received" in found[1].evidence


def test_what_alarms_are_told_from_goes_through_arrays(past: Past) -> None:
    _, past = settled(past, same=["c1"], offsets={**NONE, "c3": NEAR_DB - 1}, sharp={**SHARP, "c4": nan})
    back = Past.of_arrays(past.arrays())
    for name in NAMES:
        np.testing.assert_equal(CameraFigures.of(back, name).row(), CameraFigures.of(past, name).row())
    assert (CameraFigures.of(back, "c1").same, CameraFigures.of(back, "c3").misfit) == (1, 1)
    assert len(CameraFigures().row()) == outliers.CAMERA_FIGURES


def test_sharpness_does_not_hang_on_how_much_is_seen() -> None:
    rng = np.random.default_rng(0)
    half = rng.integers(0, 255, (64, 64, 3)).astype(np.uint8)
    less = half.copy()
    less[:, 32:] = 0
    soft = ((half[:, :-1].astype(int) + half[:, 1:]) // 2).astype(np.uint8)
    assert abs(alarms.sharpness_of(half) - alarms.sharpness_of(less)) < 0.05
    assert alarms.sharpness_of(soft) < alarms.sharpness_of(half) - SHARPNESS[1]
    assert isnan(alarms.sharpness_of(np.zeros((64, 64, 3), np.uint8)))
    assert isnan(alarms.sharpness_of(np.zeros((1, 1, 3), np.uint8)))


def test_a_scene_raises_none_and_of_one_camera_in_another_colour_one(tmp_path: Path) -> None:
    footage = SyntheticFootage()
    scene = footage.start(tmp_path)
    for index in range(1, 5):
        report = scene.step(footage.frame(index))
        assert report.alarms == []
        assert all(fit["health"] > 0.3 for fit in report.cameras.values())
    frame = footage.frame(5)
    red = (frame.images["c3"] * np.array([1.2, 1.0, 1.0])).clip(0, 255).astype(np.uint8)
    report = scene.step(Frame(5, frame.time, {**frame.images, "c3": red}, frame.masks))
    assert ("camera_colours", "c3") in kinds_of(report.alarms)
    assert {alarm.camera for alarm in report.alarms} == {"c3"}
    record = report.record()["alarms"]
    assert {"kind": "camera_colours", "camera": "c3"}.items() <= record[-1].items()
    brighter = footage.frame(6)
    images = {name: (1.3 * np.asarray(image)).clip(0, 255).astype(np.uint8) for name, image in brighter.images.items()}
    report = scene.step(replace(brighter, images=images))
    assert ("light", None) in kinds_of(report.alarms)
    assert {alarm.camera for alarm in report.alarms} <= {None, "c3"}


def region_of(*names: str, share: float = 2 * SHARE, level: float = 0.1) -> Callable[[str], ShiftedRegion]:
    return lambda name: ShiftedRegion(share, 2 * STATIC_SHARE, level) if name in names else never(name)


def brighter(amount: float, name: str = "c3") -> dict[str, float]:
    return {**NONE, name: amount}


@pytest.mark.parametrize("sign", [1, -1])
def test_dirt_raises_an_alarm_in_the_third_frame_and_as_long_as_it_stays(past: Past, sign: int) -> None:
    found = in_a_row(past, 6, differences=brighter(2 * sign * BRIGHTNESS), region=region_of("c3", level=0.1 * sign))
    assert found == [[]] * (DIRT_ROW - 1) + [[("camera_misfit", "c3")]] * (7 - DIRT_ROW)
    text = [alarm.evidence for alarm in after_frames(past, DIRT_ROW, brighter(2 * sign * BRIGHTNESS), 0.1 * sign)]
    assert text == [
        f"a region of 6% of its image is {'brighter' if sign > 0 else 'darker'} than the other cameras suggest, by 10% "
        "of the full range; check the lens for dirt"
    ]


def after_frames(past: Past, frames: int, lights: Mapping[str, float], level: float) -> list[Alarm]:
    found: list[Alarm] = []
    for _ in range(frames):
        found, past = settled(past, differences=lights, region=region_of("c3", level=level))
    return found


def test_an_image_is_searched_only_after_three_frames_in_the_same_direction(past: Past) -> None:
    for amount in (2, 2, -2, 2, 2, 0, -2, -2, 2):
        found, past = settled(past, differences=brighter(amount * BRIGHTNESS))
        assert found == []
    assert in_a_row(past, 6, differences=brighter(0.9 * BRIGHTNESS)) == [[]] * 6
    assert in_a_row(past, 6, differences=dict.fromkeys(NAMES, 5 * BRIGHTNESS)) == [[]] * 6  # all cameras see it


@pytest.mark.parametrize(
    "region",
    [
        ShiftedRegion(0.5 * SHARE, 2 * STATIC_SHARE, 0.1),
        ShiftedRegion(2 * SHARE, 2 * STATIC_SHARE, -0.1),
        ShiftedRegion(2 * SHARE, 0.5 * STATIC_SHARE, 0.1),
    ],
)
def test_a_change_without_such_a_region_becomes_usual(past: Past, region: ShiftedRegion) -> None:
    searched: list[str] = []

    def search(name: str) -> ShiftedRegion:
        searched.append(name)
        return region

    assert in_a_row(past, 8, differences=brighter(2 * BRIGHTNESS), region=search) == [[]] * 8
    assert searched == ["c3"]


def test_a_camera_with_another_alarm_is_not_searched(past: Past) -> None:
    found = in_a_row(past, 4, differences=brighter(2 * BRIGHTNESS), offsets={**NONE, "c3": LAST_DB - 1})
    assert found == [[("camera_misfit", "c3")]] * 4


def test_figures_of_an_earlier_version_are_unknown(past: Past) -> None:
    arrays = past.arrays()
    arrays["camera_figures"] = arrays["camera_figures"][:, :9]
    old = Past.of_arrays(arrays)
    np.testing.assert_equal(CameraFigures.of(old, "c3").row(), CameraFigures().row())
    _, known = settled(replace(old, camera_figures=dict(list(old.camera_figures.items())[:3])))
    assert known.arrays()["camera_figures"].shape == (len(NAMES), outliers.CAMERA_FIGURES)


def test_an_image_that_cannot_be_searched_stays_suspect(past: Past) -> None:
    for _ in range(5):
        found, past = settled(past, differences=brighter(2 * BRIGHTNESS), region=lambda name: None)
        assert found == []
    assert CameraFigures.of(past, "c3").dirt == 5


def test_no_image_is_searched_if_most_deviate(past: Past) -> None:
    most = {name: (-1) ** k * 2 * BRIGHTNESS for k, name in enumerate(NAMES)}
    assert in_a_row(past, 5, differences=most) == [[]] * 5


def test_mean_differences_are_those_of_the_median_channel() -> None:
    fits: Any = {
        "a": {"psnr": 30.0, "colour_shift": (0.5, -0.01, 0.02), "health": 1.0},
        "b": {"psnr": 30.0, "colour_shift": None, "health": 1.0},
    }
    assert mean_differences(fits) == {"a": 0.02}


def gained(name: str, *change: float) -> dict[str, Numbers]:
    return {**GREY, name: GREY[name] + np.array(change)}


def test_a_gain_that_jumps_raises_an_alarm_in_that_frame(past: Past) -> None:
    red = gained("c9", 0.22, 0, 0)
    found, past = settled(past, gains=(GREY, red))
    assert kinds_of(found) == [("camera_colours", "c9")]
    assert "its gain has jumped relative to the other cameras (red +25%, green +0%, blue +0%)" in found[0].evidence
    assert in_a_row(past, gains=(red, red)) == [[]] * 4  # the gain compensates for the change
    assert kinds_of(settled(past, gains=(red, GREY))[0]) == [("camera_colours", "c9")]


def test_gains_that_drift_and_those_of_all_cameras_raise_none(past: Past) -> None:
    for step in range(10):
        found, past = settled(past, gains=(gained("c3", 0.05 * step, 0, 0), gained("c3", 0.05 * (step + 1), 0, 0)))
        assert found == []
    brighter = {name: gains + 0.3 for name, gains in GREY.items()}
    assert settled(past, gains=(GREY, brighter))[0] == []
    apart = {name: gains + 0.25 * (-1) ** k for k, (name, gains) in enumerate(GREY.items())}
    assert settled(past, gains=(GREY, apart))[0] == []  # as when the effect is switched on


def test_gains_that_were_not_estimated_before_raise_none(past: Past) -> None:
    assert settled(past, gains=({}, gained("c9", 0.3, 0.3, 0.3)))[0] == []  # the effect has just been switched on


def test_log_gains_are_those_of_the_colour_channels() -> None:
    exposure = np.array([[1.0, 0.1], [2.0, 0.2], [0.0, 0.3], [5.0, 0.4]], np.float32)
    views: Any = [SimpleNamespace(name="a", exposure=exposure)]
    assert log_gains(views)["a"].round(3).tolist() == [0.0, 0.693, round(float(np.log(DARKEST)), 3)]
    assert CAMERA_GAIN in EFFECTS
