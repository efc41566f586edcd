"""Settings for one row of a study: a preset, its iterations and seed, and changes given as text."""

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
    """Returns a preset with changes. Frame 0 has no time limit, so results do not depend on the machine's load.

    Args:
        name: preset name.
        iterations: iterations per update; the preset's if None.
        seed: seed for frame 0 and the updates.
        changes: changes such as ``"update.clusters=[64]"``, which override everything else.

    Raises:
        ValueError: the preset or a setting is unknown, or a value is out of range.
    """
    own: dict[str, Any] = {"static": {"seed": seed, "seconds": None}, "update": {"seed": seed}}
    if iterations is not None:
        own["update"]["iterations"] = iterations
    return preset(name, own, parse_changes(changes))
