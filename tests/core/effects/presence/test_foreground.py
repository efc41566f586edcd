"""Labels from masks and from motion: what is off leaves no term and learns nothing."""

from __future__ import annotations

from dataclasses import replace

import pytest
from box_scene import make_rig, moved, take_frame
from effect_cases import BEFORE, UPDATE, builder, same, updated

from scas4d_core.effects.switches import first_switches, names_on, register_effects
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.presets import SettingError, preset
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings


def usual() -> list[str]:
    return list(names_on(first_switches(Settings(update=UPDATE), 0)))


def test_without_the_mask_term_masks_pull_at_nothing() -> None:
    without = [name for name in usual() if name != "mask_term"]
    assert register_effects(builder(), without).plan.mask == 0 < register_effects(builder(), usual()).plan.mask
    off = UPDATE.weights.model_copy(update={"mask": 0.0, "mask_alone": 0.0})
    weightless = UPDATE.model_copy(update={"weights": off})
    assert same(updated(without), updated(usual(), weightless.model_copy(update={"use_masks": False})))
    assert not same(updated(without), updated(usual()))


def test_a_scene_without_masks_says_that_it_has_no_mask_term() -> None:
    with_masks, without = (start("auto", masks)._prepared.carried.switches["mask_term"] for masks in (True, False))
    assert (with_masks.on, with_masks.text) == (True, "")
    assert (without.on, without.text) == (False, "the first frame has no masks")
    report = start("auto").history.report(0)["effects"]["mask_term"]
    assert not report["on"]


@pytest.mark.parametrize("update", [{"use_masks": False}, {"weights": {"mask": 0, "mask_alone": 0}}])
def test_a_mask_term_that_the_settings_contradict_is_refused(update: dict[str, object]) -> None:
    assert not first_switches(preset("scas4d", {"update": update}), 0)["mask_term"].on
    with pytest.raises(SettingError, match=r"effects\.mask_term cannot be 'on'"):
        preset("scas4d", {"effects": {"mask_term": "on"}, "update": update})


def start(labels: str, masks: bool = False) -> Reconstruction:
    settings = Settings(update=UPDATE.model_copy(update={"iterations": 2}), effects={"motion_labels": labels})
    everything = StaticResult(BEFORE.replace(foreground=0 * BEFORE.foreground + 1), {}, [])
    return Reconstruction.start(make_rig(), take_frame(0, 0.0, BEFORE, make_rig(), masks), settings, static=everything)


def test_labels_are_learnt_from_motion_where_no_masks_are_given_and_the_effect_is_on() -> None:
    frame = take_frame(1, 1.0, moved(BEFORE), make_rig(), masks=False)
    learnt, held, masked = start("auto"), start("off"), start("auto", masks=True)
    assert len(learnt._prepared.carried.seen) == len(frame.images)
    assert list(held._prepared.carried.seen) == list(masked._prepared.carried.seen) == []
    assert learnt.step(frame).moving < len(BEFORE)
    assert held.step(frame).moving == len(BEFORE)
    assert list(held._prepared.carried.seen) == []
    assert masked.step(replace(frame, masks={})).moving == len(BEFORE)
