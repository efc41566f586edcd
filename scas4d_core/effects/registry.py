"""Names of all effects, and the module of each: adding one is a file and a line here.

Names only: a module is imported when its effect is first asked for (``effect.effect``).
"""

from __future__ import annotations

from typing import Literal

Mode = Literal["auto", "on", "off"]
"""Left to the evidence, pinned on, pinned off."""

EFFECTS = {
    "rigidity": "scas4d_core.effects.coherence.rigidity",
    "isometry": "scas4d_core.effects.coherence.isometry",
    "rotation": "scas4d_core.effects.coherence.rotation",
    "axis_length": "scas4d_core.effects.coherence.axis_length",
    "floor": "scas4d_core.effects.coherence.floor",
    "moving_colour": "scas4d_core.effects.appearance.moving_colour",
    "standing_colour": "scas4d_core.effects.appearance.standing_colour",
    "direction": "scas4d_core.effects.appearance.direction",
}
"""The module of each effect, by its name; in the order in which they take part in an iteration."""
