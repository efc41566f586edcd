"""Named settings presets, and functions that apply changes to settings."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from pydantic import BaseModel, ValidationError

from scas4d_core.effect_names import Mode
from scas4d_core.effects.switches import find_contradictions
from scas4d_core.errors import InputError
from scas4d_core.settings import Settings, StaticSettings, UpdateSettings, Weights

TIES = ("rigidity", "isometry", "rotation")
"""Effects that couple neighbouring Gaussians."""


OURS = (
    "bending",
    "shading",
    "shadows",
    "camera_gain",
    "pose_drift",
    "light",
    "direction",
    "uncovered",
    "entering",
    "leaving",
)
"""Effects that are in neither the paper nor Dynamic3DGaussians."""


def _pinned(on: Iterable[str] = (), off: Iterable[str] = ()) -> dict[str, Mode]:
    """Returns the modes of some effects, as for ``Settings.effects``."""
    return {**dict.fromkeys(on, "on"), **dict.fromkeys(off, "off")}


PRESETS: dict[str, Settings] = {
    "scas4d": Settings(),
    # Half the iterations of the default, except in a cold start, and no iterations if nothing has
    # moved (docs/accuracy-and-time.md).
    "adaptive": Settings(update=UpdateSettings(iterations=50, cold_start_iterations=6.0, skip_tolerance=0.02)),
    # Fewer iterations than "adaptive", and 30% of the Gaussians. An update takes about 30% of the
    # time of the default.
    "fast": Settings(
        static=StaticSettings(detail=0.3),
        update=UpdateSettings(iterations=45, cold_start_iterations=6.0, skip_tolerance=0.02),
    ),
    # The choices of the paper instead of those of this project (docs/method.md). Learning rates
    # that the paper does not specify are those of this project.
    "paper": Settings(
        update=UpdateSettings(
            cluster_map="published",
            deltas_start=0.0,
            cold_start_iterations=1.0,
            cold_start_rates=1.0,
            momentum=1.0,
            reject_outliers=False,
            skip_tolerance=-1.0,
            weights=Weights(isometry=2.0),
        ),
        effects=_pinned(on=("static_colour",), off=OURS),
    ),
    # Per-Gaussian updates with the authors' terms, weights and rates (Dynamic3DGaussians, train.py).
    "dynamic3dgs": Settings(
        update=UpdateSettings(
            clusters=(),
            deltas_start=0.0,
            rate_rotation=0.001,
            rate_scale=0.0,
            final_rate=1.0,
            beta1=0.9,
            beta2=0.999,
            rate_static_colour=0.0025,
            momentum=1.0,
            cold_start_iterations=1.0,
            cold_start_rates=1.0,
            reject_outliers=False,
            skip_tolerance=-1.0,
            weights=Weights(mask=3.0, mask_alone=3.0, isometry=2.0, scale=0.0),
        ),
        effects=_pinned(on=("static_colour",), off=OURS),
    ),
    # Presets for kinds of scenes (docs/effects.md). Some effects are pinned, and all others are
    # "auto". Weights and rates are those of the default. If a kind of scene always or never needs a
    # new effect, pin the effect in the preset of this kind.
    "rigid": Settings(effects=_pinned(on=TIES, off=("cluster_scaling", "own_rotation", "own_scale"))),
    "articulated": Settings(effects=_pinned(on=("cluster_rotation", "own_position", *TIES))),
    "cloth": Settings(effects=_pinned(on=("bending", "cluster_scaling", "isometry", "own_position"))),
    "people": Settings(effects=_pinned(on=("motion_labels", "shadows", "own_position", *TIES), off=("direction",))),
    "lights": Settings(effects=_pinned(on=("motion_labels", "moving_colour", "shadows", "light"))),
}


class SettingError(InputError):
    """Raised for an unknown setting, a value that is out of range, or contradictory effects.

    Attributes:
        setting: dotted name of the setting, such as "update.iterations".
        value: rejected value.
        fault: user-facing description of the problem.
        remedy: user-facing description of valid input.
        validation: error raised by pydantic, or None for an unknown preset or contradictory effects.
    """

    def __init__(
        self, setting: str, value: object, fault: str, remedy: str, validation: ValidationError | None = None
    ) -> None:
        super().__init__(fault, remedy)
        self.args = (f"setting {setting}={value!r}: {fault}; {remedy}",)
        self.setting = setting
        self.value = value
        self.validation = validation


def preset(name: str, *changes: Mapping[str, Any]) -> Settings:
    """Returns the settings of a preset, with changes.

    Args:
        name: name of the preset.
        changes: nested mappings of settings to change. Later mappings take precedence.

    Raises:
        SettingError: if the preset or a setting does not exist, a value is out of range, or effects contradict each
            other.

    >>> preset("adaptive").update.iterations
    50
    >>> preset("adaptive", {"update": {"iterations": 20}}, {"device": "cpu"}).update.iterations
    20
    """
    if name not in PRESETS:
        known = ", ".join(sorted(PRESETS))
        raise SettingError("preset", name, "no such preset", f"choose from {known}")
    return changed(PRESETS[name], *changes)


def changed(settings: Settings, *changes: Mapping[str, Any]) -> Settings:
    """Returns the settings with changes.

    Args:
        settings: settings to start from.
        changes: nested mappings of settings to change. Later mappings take precedence.

    Raises:
        SettingError: if a setting does not exist, a value is out of range, or effects contradict each other.

    >>> changed(preset("adaptive"), {"update": {"iterations": 20}}).update.iterations
    20
    """
    if not any(changes):
        return settings
    values = settings.model_dump()
    for change in changes:
        values = _merged(values, change)
    try:
        settings = Settings.model_validate(values)
    except ValidationError as error:
        raise _setting_error(error) from None
    for name, mode, fault, remedy in find_contradictions(settings):
        raise SettingError(f"effects.{name}", mode, fault, remedy)
    return settings


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the union of two nested mappings, in which values of ``changes`` take precedence."""
    result = dict(base)
    for name, value in changes.items():
        old = result.get(name)
        result[name] = _merged(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return result


def _setting_error(error: ValidationError) -> SettingError:
    """Converts a pydantic error to a ``SettingError``.

    If the pydantic error lists several faults, only the first is described in detail.
    For an unknown setting, the remedy suggests the setting with the most similar name.
    """
    details = error.errors(include_url=False)
    first = details[0]
    setting = _place(first["loc"])
    others = len({_place(one["loc"]) for one in details}) - 1  # every member of a union reports an error
    more = f" (and {others} more)" if others else ""
    remedy = "docs/settings.md lists all settings"
    if first["type"] == "extra_forbidden":
        fault = "no such setting"
        if near := difflib.get_close_matches(setting, list(_names(Settings().model_dump())), 1):
            remedy = f"did you mean {near[0]}? {remedy}"
    elif first["type"] == "value_error":
        own = first["ctx"]["error"]
        fault, remedy = (own.fault, own.remedy) if isinstance(own, InputError) and own.remedy else (str(own), remedy)
    else:
        fault = first["msg"]
        if said := _description(first["loc"]):
            remedy = f"{said} {remedy}"
    return SettingError(setting, first["input"], f"{fault}{more}", remedy, error)


def _place(loc: Iterable[int | str]) -> str:
    """Converts a location in a pydantic error to a dotted name, such as ``scene.background.2``."""
    return ".".join(str(part) for part in loc if not _of_union(part))


def _description(loc: Iterable[int | str]) -> str:
    """Returns the description of a setting, or an empty string if the setting has none.

    Args:
        loc: location of the setting in a pydantic error.

    >>> _description(("scene", "image_scale", "float"))
    'Scale factor applied to all images before any other step.'
    """
    said = ""
    model: type[BaseModel] = Settings
    for part in loc:
        if not isinstance(part, str) or part not in model.model_fields:
            break
        field = model.model_fields[part]
        said = field.description or ""
        if not (isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)):
            break
        model = field.annotation
    return said


def _of_union(part: int | str) -> bool:
    """Returns whether a part of a pydantic location is a type in a union, not a setting.

    An example of such a part is ``literal['auto']``.
    """
    return isinstance(part, str) and (not part.isidentifier() or part in ("bool", "float", "int", "str"))


def _names(values: Mapping[str, Any], under: str = "") -> Iterator[str]:
    """Yields the dotted names of all settings and groups of settings.

    Args:
        values: nested mapping of settings.
        under: prefix of the names.
    """
    for name, value in values.items():
        yield f"{under}{name}"
        if isinstance(value, Mapping):
            yield from _names(value, f"{under}{name}.")
