"""A row to be measured: which capture, with which settings, with what withheld."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scas4d_core.presets import preset
from scas4d_core.settings import Settings
from studies.quality.store import Row, digest


@dataclass(frozen=True)
class Job:
    """One row to be measured.

    Attributes:
        capture: folder.
        preset: name, for the table.
        settings: what is run, complete.
        frames: only so many frames of the capture; None: all.
        masks: whether the method gets the masks (they are always used to measure).
        points: whether the method gets the initial cloud.
        pictures: frames whose comparison pictures are saved; negative ones count from the end.
        lpips: also LPIPS; loads torch.
        constants: of the method, by dotted name, with another value (``studies.constants``).
    """

    capture: Path
    preset: str
    settings: Settings
    frames: int | None = None
    masks: bool = True
    points: bool = True
    pictures: tuple[int, ...] = (0, 1, -1)
    lpips: bool = False
    constants: tuple[tuple[str, Any], ...] = ()

    @property
    def record(self) -> Row:
        """The settings and constants as the row has them."""
        return recorded(self.settings, self.constants)

    @property
    def variant(self) -> str:
        """What is the same over captures: preset, iterations and everything else that is set."""
        update = self.settings.update
        given: Row = {"frames": self.frames, "masks": self.masks, "points": self.points}
        if self.lpips:
            given["lpips"] = True
        return f"{self.preset}-{update.iterations}-s{update.seed}-{digest(self.record, given)}"

    @property
    def changes(self) -> str:
        """What differs from the preset beside iterations and seed, and what is withheld, in words for the table."""
        usual, own = preset(self.preset).model_dump(mode="json"), self.record
        words = [
            f"{name}={json.dumps(value, separators=(',', ':'))}"
            for name, value in _flat(own)
            if name not in ("update.iterations", "update.seed", "static.seed") and dict(_flat(usual)).get(name) != value
        ]
        return ", ".join(words + ["no masks"] * (not self.masks) + ["no points"] * (not self.points))

    @property
    def key(self) -> str:
        """Names the row; another setting is another row."""
        return f"{self.capture.resolve().name}-{self.variant}"


def settings_of(
    name: str,
    iterations: int | None = None,
    seed: int = 0,
    overrides: Sequence[str] = (),
    device: str | None = None,
) -> Settings:
    """A preset with changes, checked.

    Raises:
        ValueError: an unknown preset or setting, or a value out of range.
    """
    values = preset(name).model_dump()
    values["static"]["seed"] = values["update"]["seed"] = seed
    if iterations is not None:
        values["update"]["iterations"] = iterations
    if device is not None:
        values["device"] = device
    for change in overrides:
        path, sign, text = change.partition("=")
        if not sign:
            raise ValueError(f"override {change!r} has no '='; write it as update.iterations=100")
        *groups, last = path.strip().split(".")
        inner = values
        for group in groups:
            if not isinstance(inner.get(group), dict):
                raise ValueError(f"override {change!r}: there is no group of settings {group!r}")
            inner = inner[group]
        try:
            inner[last] = json.loads(text)
        except json.JSONDecodeError:
            inner[last] = text.strip()
    return Settings.model_validate(values)


def recorded(settings: Settings, constants: Sequence[tuple[str, Any]]) -> Row:
    """Settings as JSON, with those constants of the method that have another value, where there are any."""
    return settings.model_dump(mode="json") | ({"constants": dict(constants)} if constants else {})


def _flat(values: Mapping[str, Any], under: str = "") -> Iterator[tuple[str, Any]]:
    """``{"update": {"iterations": 100}}`` as ``("update.iterations", 100)``."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{under}{name}.")
        else:
            yield f"{under}{name}", value
