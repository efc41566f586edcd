"""Effects: what is off does not exist in an update, contradictions are refused, switches follow evidence."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass, replace

import numpy as np
import pytest
from effect_cases import BEFORE, RIG, UPDATE, builder, same, updated
from source_tree import ROOT

from scas4d_core.effect_names import EFFECTS
from scas4d_core.effects import effect as effect_module
from scas4d_core.effects.coherence.floor import FLOOR_WEIGHT
from scas4d_core.effects.effect import Effect, EffectGroup, effect
from scas4d_core.effects.evidence import Evidence, FrameObservation
from scas4d_core.effects.switches import IDLE, Switch, decide_switches, first_switches, names_on, register_effects
from scas4d_core.errors import InputError
from scas4d_core.presets import SettingError, preset
from scas4d_core.settings import SceneSettings, Settings
from scas4d_core.update.parts import PlanBuilder, UpdatePart

WEIGHTS = ("rigidity", "isometry", "rotation", "scale")


@pytest.mark.parametrize("name", EFFECTS)
def test_every_effect_describes_itself(name: str) -> None:
    one = effect(name)
    assert one.name == name
    assert one.group.value in EFFECTS[name]  # it lies in the folder of its group
    assert all(
        text and text[0].isalnum() and len(text) > 15 for text in (one.description, one.disambiguation, one.cost)
    )
    assert one.description.endswith(".")


def test_the_descriptions_are_light() -> None:
    program = f"import sys, {', '.join(EFFECTS.values())}; print('numba' in sys.modules, 'torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]


def test_an_effect_that_is_off_has_no_part() -> None:
    off = register_effects(builder(), [])
    assert off.parts == []
    assert off.plan.axis_length == 0
    assert (off.plan.neighbour_terms, off.plan.colours) == (False, None)
    plan = register_effects(builder(), ["isometry", "static_colour"]).plan
    assert plan.neighbour_terms
    assert (plan.rigidity, plan.isometry, plan.rotation) == (0, UPDATE.weights.isometry, 0)
    assert plan.colours is not None
    assert (plan.colours.moving, plan.colours.static) == (False, True)


@pytest.mark.parametrize(
    ("name", "weights"),
    [
        ("rigidity", {"rigidity": 0}),
        ("isometry", {"isometry": 0}),
        ("rotation", {"rotation": 0}),
        ("axis_length", {"scale": 0}),
    ],
)
def test_off_is_a_weight_of_nothing(name: str, weights: dict[str, float]) -> None:
    usual = names_on(first_switches(Settings(update=UPDATE), 0))
    without = [other for other in usual if other != name]
    weightless = UPDATE.model_copy(update={"weights": UPDATE.weights.model_copy(update=weights)})
    assert same(updated(without), updated(list(usual), weightless))
    assert not same(updated(without), updated(list(usual)))


def test_colours_that_no_effect_frees_stay() -> None:
    usual = names_on(first_switches(Settings(update=UPDATE), 0))
    moving = BEFORE.moving
    held = updated([name for name in usual if name != "static_colour"])["colours"]
    assert np.array_equal(held[~moving], BEFORE.colours[~moving])
    assert not np.array_equal(held[moving], BEFORE.colours[moving])
    assert np.array_equal(
        updated([name for name in usual if "colour" not in name and name != "shading"])["colours"], BEFORE.colours
    )


def test_a_scene_without_a_floor_has_no_floor_term() -> None:
    assert not first_switches(Settings(), 0)["floor"].on
    scene = SceneSettings(floor=(0, 1, 0, -0.5))
    assert first_switches(Settings(scene=scene), 0)["floor"].on
    plan = register_effects(builder(scene)).plan
    assert (plan.floor, plan.floor_weight) == (scene.floor, FLOOR_WEIGHT)
    without = register_effects(builder()).plan
    assert (without.floor, without.floor_weight) == (None, 0.0)


@pytest.mark.parametrize(
    ("given", "fault", "remedy"),
    [
        ({"effects": {"floor": "on"}}, "effects.floor cannot be 'on': the scene has no floor plane", "set scene.floor"),
        (
            {"effects": {"rigidity": "on"}, "update": {"weights": {"rigidity": 0}}},
            "effects.rigidity cannot be 'on': update.weights.rigidity is 0",
            "use a weight above 0",
        ),
        ({"effects": {"flour": "off"}}, "unknown effect 'flour'", "did you mean floor?"),
        ({"effects": {"floor": "maybe"}}, "Input should be 'auto', 'on' or 'off'", ""),
    ],
)
def test_contradictions_are_refused(given: dict[str, object], fault: str, remedy: str) -> None:
    with pytest.raises(SettingError) as caught:
        preset("scas4d", given)
    assert fault in caught.value.fault
    assert remedy in caught.value.remedy
    assert caught.value.setting.startswith("effects")


@pytest.mark.parametrize("name", EFFECTS)
def test_refusals_of_one_kind_have_one_text(name: str) -> None:
    """A rate or weight of 0 is refused in the same words by all effects that refuse it."""
    for key in ("rate_colour", "rate_static_colour", "rate_scale", *(f"weights.{one}" for one in WEIGHTS)):
        first, _, last = key.partition(".")
        zero = Settings.model_validate({"update": {first: {last: 0} if last else 0}, "scene": {"floor": (0, 1, 0, 0)}})
        refusal = effect(name).refusal(zero)
        kind = "weight" if last else "rate"
        assert refusal in (None, (f"update.{key} is 0", f"use a {kind} above 0"))


def test_a_pinned_effect_is_on_or_off() -> None:
    assert not first_switches(preset("scas4d", {"effects": {"isometry": "off"}}), 0)["isometry"].on
    with pytest.raises(InputError, match="cannot be 'on'"):
        first_switches(Settings(effects={"floor": "on"}), 0)


@dataclass(frozen=True)
class Shy(Effect):
    """An effect that goes by the number of the frame alone."""

    def evidence(self, seen: FrameObservation) -> Evidence | None:
        share = {0: 0.5, 1: 0.9, 2: None}.get(seen.index, 0.1)
        return None if share is None else Evidence(share, f"frame {seen.index}")

    def register(self, builder: PlanBuilder) -> None:
        builder.parts.append(UpdatePart())


SHY = Shy("shy", EffectGroup.MOTION, "It moves.", "none", "none", auto=True, on_above=0.8, off_below=0.3)


@pytest.fixture
def shy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EFFECTS, "shy", "nowhere")
    found = effect_module.effect
    for module in ("scas4d_core.effects.switches",):
        monkeypatch.setattr(sys.modules[module], "effect", lambda name: SHY if name == "shy" else found(name))


def seen(index: int) -> FrameObservation:
    return FrameObservation(index, BEFORE, None, RIG, [], None)  # type: ignore[arg-type]


@pytest.mark.usefixtures("shy")
def test_evidence_switches_with_hysteresis() -> None:
    settings = Settings()
    switches = {"shy": first_switches(settings, 0)["shy"]}
    assert not switches["shy"].on
    on = []
    for index in range(3 + IDLE):
        switches = decide_switches(switches, settings, seen(index))
        on.append(switches["shy"].on)
    assert on == [False, True, True, *[True] * (IDLE - 1), False]
    assert switches["shy"] == Switch(False, 2 + IDLE, share=0.1, text=f"frame {2 + IDLE}")


@pytest.mark.usefixtures("shy")
def test_a_pinned_switch_hears_no_evidence() -> None:
    settings = Settings(effects={"shy": "off"})
    switches = decide_switches({"shy": first_switches(settings, 0)["shy"]}, settings, seen(1))
    assert not switches["shy"].on
    assert switches["shy"].pinned


@pytest.mark.usefixtures("shy")
def test_switches_stay_where_nothing_is_seen() -> None:
    settings = Settings()
    switches = {name: first_switches(settings, 0)[name] for name in ("rigidity", "floor", "shy")}
    assert decide_switches(switches, settings, seen(2)) == {name: replace(switch) for name, switch in switches.items()}
