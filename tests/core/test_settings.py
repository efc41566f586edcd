"""Settings: presets, what is refused, and that every number is read somewhere."""

from __future__ import annotations

import importlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import pytest
from pydantic import BaseModel, ValidationError

from scas4d_core import settings as module
from scas4d_core.presets import PRESETS, preset
from scas4d_core.settings import Settings, UpdateSettings, Weights

CORE = Path(module.__file__).parent
READERS = "\n".join(path.read_text() for path in CORE.rglob("*.py") if path.name not in ("settings.py", "presets.py"))

# Names that mean something else elsewhere are looked for with what they hang on.
HANGS_ON = {"Weights": r"weights", "Settings": r"settings", "SceneSettings": r"scene", "LayerRates": r"\w+"}


def models() -> list[type[module.Model]]:
    own = [value for value in vars(module).values() if isinstance(value, type) and issubclass(value, module.Model)]
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


def test_an_unknown_preset_names_those_there_are() -> None:
    with pytest.raises(ValueError, match=r"'fast' is unknown; choose one of .*scas4d"):
        preset("fast")


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
        {"update": {"neighbour_falloff": float("inf")}},
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


class Former(module.Model):
    constants: ClassVar[Mapping[str, module.Constant]] = {
        "length": module.Constant(0.02, "here.LENGTH"),
        "starts": module.Constant((0.0, 0.2), "here.STARTS"),
    }
    kept: int = 1


class Nested(module.Model):
    inner: Former = Former()


@pytest.mark.parametrize("given", [{}, {"length": 0.02}, {"starts": [0, 0.2]}, {"starts": (0.0, 0.2), "length": 0.02}])
def test_a_former_setting_is_taken_at_the_value_of_its_constant_and_dropped(given: dict[str, Any]) -> None:
    assert Nested.model_validate({"inner": {**given, "kept": 2}}) == Nested(inner=Former(kept=2))
    assert "length" not in Nested.model_validate({"inner": given}).model_dump()["inner"]


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("length", 2.0, "length cannot be 2.0: it is no setting any more, it is the constant here.LENGTH = 0.02 now"),
        ("length", True, "length cannot be True"),
        ("starts", [0.0, 0.3], r"starts cannot be \[0.0, 0.3\]: .* here.STARTS = \[0.0, 0.2\] now"),
    ],
)
def test_a_former_setting_with_another_value_is_refused_by_name(name: str, value: object, said: str) -> None:
    with pytest.raises(ValidationError, match=said) as refused:
        Nested.model_validate({"inner": {name: value, "other": 1}})
    assert refused.value.errors()[0]["loc"] == ("inner", name)
    assert refused.value.errors()[0]["type"] == "constant"


CONSTANTS = [(model, name) for model in (module.Model, *models()) for name in model.constants]


@pytest.mark.parametrize(("model", "name"), CONSTANTS, ids=lambda v: v if isinstance(v, str) else v.__name__)
def test_the_constant_of_a_former_setting_is_where_it_is_said_to_be(model: type[module.Model], name: str) -> None:
    constant = model.constants[name]
    assert name not in model.model_fields
    owner, _, attribute = constant.place.rpartition(".")
    assert not owner or getattr(importlib.import_module(owner), attribute) == constant.value
