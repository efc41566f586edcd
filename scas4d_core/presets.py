"""Named settings, and what a scene changes in them."""

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
"""Effects that tie neighbours together."""


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
"""Effects that neither the paper nor Dynamic3DGaussians has."""


def _pinned(on: Iterable[str] = (), off: Iterable[str] = ()) -> dict[str, Mode]:
    """Effects as ``Settings.effects`` has them."""
    return {**dict.fromkeys(on, "on"), **dict.fromkeys(off, "off")}


PRESETS: dict[str, Settings] = {
    "scas4d": Settings(),
    # Half of the iterations but for the first motion, and none where nothing moved (docs/accuracy-and-time.md).
    "adaptive": Settings(update=UpdateSettings(iterations=50, cold_start_iterations=6.0, skip_tolerance=0.02)),
    # Still fewer, and a third of the Gaussians: a third of the default's time.
    "fast": Settings(
        static=StaticSettings(detail=0.3),
        update=UpdateSettings(iterations=45, cold_start_iterations=6.0, skip_tolerance=0.02),
    ),
    # What the paper says, in place of what this project chose beside it (docs/method.md); rates it does not give.
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
    # By kind of scene: effects that are pinned, all others "auto"; no weight, no rate (figures: docs/effects.md).
    # A new effect that a kind of scene always or never calls for is pinned here.
    "rigid": Settings(effects=_pinned(on=TIES, off=("cluster_scaling", "own_rotation", "own_scale"))),
    "articulated": Settings(effects=_pinned(on=("cluster_rotation", "own_position", *TIES))),
    "cloth": Settings(effects=_pinned(on=("bending", "cluster_scaling", "isometry", "own_position"))),
    "people": Settings(effects=_pinned(on=("motion_labels", "shadows", "own_position", *TIES), off=("direction",))),
    "lights": Settings(effects=_pinned(on=("motion_labels", "moving_colour", "shadows", "light"))),
}


class SettingError(InputError):
    """A setting that is unknown, or a value that is out of its range.

    Attributes:
        setting: its dotted name, as "update.iterations".
        value: the refused value.
        fault: what is wrong, for a person.
        remedy: what to give instead, for a person.
        validation: pydantic's own error; None for an unknown preset.
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
    """The settings called ``name``, with changes given as nested mappings; later ones go over earlier ones.

    Raises:
        SettingError: no such preset or setting, or a value out of its range.

    >>> preset("adaptive").update.iterations
    50
    >>> preset("adaptive", {"update": {"iterations": 20}}, {"device": "cpu"}).update.iterations
    20
    """
    if name not in PRESETS:
        known = ", ".join(sorted(PRESETS))
        raise SettingError("preset", name, "there is no preset of this name", f"give one of {known}")
    return changed(PRESETS[name], *changes)


def changed(settings: Settings, *changes: Mapping[str, Any]) -> Settings:
    """The settings with changes given as nested mappings; later ones go over earlier ones.

    Raises:
        SettingError: no such setting, or a value out of its range.

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
    """Nested mappings, the second over the first."""
    result = dict(base)
    for name, value in changes.items():
        old = result.get(name)
        result[name] = _merged(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return result


def _setting_error(error: ValidationError) -> SettingError:
    """The first error of a validation, with the nearest known name as the remedy for an unknown one."""
    details = error.errors(include_url=False)
    first = details[0]
    setting = _place(first["loc"])
    others = len({_place(one["loc"]) for one in details}) - 1  # members of a union each say why they do not match
    more = f" (and {others} more)" if others else ""
    remedy = "docs/settings.md lists all settings"
    if first["type"] == "extra_forbidden":
        fault = "there is no setting of this name"
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
    """The name of a setting, as ``scene.background.2``."""
    return ".".join(str(part) for part in loc if not _of_union(part))


def _description(loc: Iterable[int | str]) -> str:
    """The sentence of the docs on a setting; empty where they have none.

    >>> _description(("scene", "image_scale", "float"))
    'Pictures are resized by this before anything else.'
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
    """True where a part of a place names a member of a union, as ``literal['auto']``, and no setting."""
    return isinstance(part, str) and (not part.isidentifier() or part in ("bool", "float", "int", "str"))


def _names(values: Mapping[str, Any], under: str = "") -> Iterator[str]:
    """The dotted names of all settings and of their groups."""
    for name, value in values.items():
        yield f"{under}{name}"
        if isinstance(value, Mapping):
            yield from _names(value, f"{under}{name}.")
