"""Settings: presets, what is refused, and that every number is read somewhere."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel, ValidationError

from scas4d_core import settings as module
from scas4d_core.effects.switches import find_contradictions
from scas4d_core.presets import PRESETS, SettingError, preset
from scas4d_core.settings import Settings, UpdateSettings, Weights

CORE = Path(module.__file__).parent
READERS = "\n".join(path.read_text() for path in CORE.rglob("*.py") if path.name not in ("settings.py", "presets.py"))

# Names that mean something else elsewhere are looked for with what they hang on.
HANGS_ON = {"Weights": r"weights", "Settings": r"settings", "SceneSettings": r"scene", "LayerRates": r"\w+"}


def models() -> list[type[module.SettingsModel]]:
    own = [
        value for value in vars(module).values() if isinstance(value, type) and issubclass(value, module.SettingsModel)
    ]
    return [model for model in own if model.model_fields]


@pytest.mark.parametrize(
    ("model", "name"), [(model, name) for model in models() for name in model.model_fields], ids=lambda v: str(v)
)
def test_every_setting_is_described_and_read(model: type[BaseModel], name: str) -> None:
    assert name in ("scene", "static", "update", "weights") or model.model_fields[name].description
    owner = HANGS_ON.get(model.__name__, r"(settings|static|update)")
    assert re.search(rf"\b{owner}\.{name}\b", READERS), f"{model.__name__}.{name} changes nothing"


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_presets_survive_json_and_do_not_change(name: str) -> None:
    settings = preset(name)
    assert Settings.model_validate_json(settings.model_dump_json()) == settings
    with pytest.raises(ValidationError):
        settings.update.iterations = 3  # type: ignore[misc]


def test_presets_are_what_they_are_called() -> None:
    assert preset("scas4d") == Settings()
    assert preset("scas4d").update.clusters == (64, 320, 1280)
    assert preset("dynamic3dgs").update.clusters == ()
    assert set(PRESETS) >= {"scas4d", "dynamic3dgs"}


KINDS = ("rigid", "articulated", "cloth", "people", "lights")


@pytest.mark.parametrize("name", KINDS)
def test_a_preset_of_a_kind_of_scene_pins_effects_and_nothing_else(name: str) -> None:
    found = preset(name)
    assert found.effects
    assert found.model_copy(update={"effects": {}}) == Settings()
    assert list(find_contradictions(found)) == []
    assert preset(name, {"effects": dict.fromkeys(found.effects, "auto")}).effects == dict.fromkeys(
        found.effects, "auto"
    )


def test_what_contradicts_a_preset_is_refused() -> None:
    with pytest.raises(SettingError, match=r"effects\.rotation='on': .* update\.weights\.rotation is 0"):
        preset("rigid", {"update": {"weights": {"rotation": 0}}})


def test_an_unknown_preset_names_those_there_are() -> None:
    with pytest.raises(ValueError, match=r"preset='faster': no such preset; choose from .*scas4d"):
        preset("faster")


@pytest.mark.parametrize(
    "wrong",
    [
        {"updates": {}},
        {"update": {"iteration": 5}},
        {"update": {"iterations": 0}},
        {"update": {"cluster_map": "affine"}},
        {"update": {"beta1": 1.0}},
        {"update": {"weights": {"image": 0}}},
        {"update": {"weights": {"rigidity": -1}}},
        {"update": {"rate_position": float("nan")}},
        {"update": {"max_scale": 0.02}},  # a constant of the method is no setting
        {"update": {"weights": {"mask": float("inf")}}},
        {"update": {"clusters": (64, 32)}},
        {"update": {"clusters": (0, 32)}},
        {"update": {"layer_rates": ()}},
        {"scene": {"metres_per_unit": 0}},
        {"scene": {"metres_per_unit": float("inf")}},
        {"scene": {"metres_per_unit": "big"}},
        {"scene": {"image_scale": 1.5}},
        {"scene": {"background": (0, float("nan"), 0)}},
        {"static": {"max_gaussians": 0}},
        {"device": "tpu"},
    ],
    ids=str,
)
def test_wrong_values_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        Settings.model_validate(wrong)


def test_right_values_are_taken() -> None:
    read = Settings.model_validate(
        {"scene": {"metres_per_unit": "auto"}, "update": {"clusters": [4], "weights": {"rigidity": 0}}}
    )
    assert read.update == UpdateSettings(clusters=(4,), weights=Weights(rigidity=0))
    assert read.scene.metres_per_unit == "auto"


def test_a_constant_of_the_method_is_refused_as_an_unknown_setting() -> None:
    with pytest.raises(SettingError, match=r"update\.max_scale=0\.02: no such setting"):
        preset("scas4d", {"update": {"max_scale": 0.02}})


def test_changes_go_over_the_preset_later_ones_over_earlier_ones() -> None:
    changed = preset(
        "adaptive", {"update": {"iterations": 20, "seed": 3}}, {"update": {"seed": 4}, "effects": {"floor": "off"}}
    )
    assert (changed.update.iterations, changed.update.seed, changed.effects) == (20, 4, {"floor": "off"})
    assert changed.update.beta1 == PRESETS["adaptive"].update.beta1
    assert PRESETS["adaptive"].update.iterations == 50
    assert preset("adaptive", {}) == PRESETS["adaptive"]


@pytest.mark.parametrize(
    ("changes", "setting", "value", "words"),
    [
        ({"update": {"iteration": 4}}, "update.iteration", 4, "did you mean update.iterations?"),
        ({"update": {"iterations": 0}}, "update.iterations", 0, "greater than or equal to 1"),
        ({"update": {"clusters": [64, 8]}}, "update.clusters", [64, 8], "must be in ascending order"),
        ({"upd": {"seed": 1}}, "upd", {"seed": 1}, "no such setting"),
        ({"update": 4}, "update", 4, "UpdateSettings"),
        ({"scene": {"background": 2}}, "scene.background", 2, "a valid tupleBackground colour as RGB values in [0, 1]"),
        ({"scene": {"background": 2, "near": 0}}, "scene.background", 2, "(and 1 more)"),
    ],
)
def test_a_refused_change_names_setting_value_fault_and_remedy(
    changes: dict[str, object], setting: str, value: object, words: str
) -> None:
    with pytest.raises(SettingError) as refused:
        preset("scas4d", changes)
    error = refused.value
    assert (error.setting, error.value) == (setting, value)
    assert words in error.fault + error.remedy
    assert str(error) == f"setting {setting}={value!r}: {error.fault}; {error.remedy}"
    assert error.remedy
