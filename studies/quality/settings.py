"""Settings of a study's row: a preset, its iterations and seed, and changes as text."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from client.cli.changes import parse_changes
from scas4d_core.presets import preset
from scas4d_core.settings import Settings


def settings_of(
    name: str,
    iterations: int | None = None,
    seed: int = 0,
    changes: Sequence[str] = (),
) -> Settings:
    """Returns a preset with changes, without a time limit for frame 0, so that results do not depend on machine load.

    Args:
        name: of the preset.
        iterations: of an update; the preset's where None.
        seed: of frame 0 and of the updates.
        changes: as ``"update.clusters=[64]"``; they go over all else.

    Raises:
        ValueError: an unknown preset or setting, or a value out of range.
    """
    own: dict[str, Any] = {"static": {"seed": seed, "seconds": None}, "update": {"seed": seed}}
    if iterations is not None:
        own["update"]["iterations"] = iterations
    return preset(name, own, parse_changes(changes))
