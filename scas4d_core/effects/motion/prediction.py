"""Prediction: an update starts from the motion of the previous frame (paper, Optimization Pipeline).

``update.warm_start`` extrapolates the motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from scas4d_core.effects.effect import Effect, EffectGroup
from scas4d_core.update.parts import PlanBuilder

if TYPE_CHECKING:
    from scas4d_core.settings import Settings

CLUSTERS = ("cluster_rotation", "cluster_translation")
OWN = ("own_position", "own_rotation")
"""Effects whose parameters are extrapolated for individual Gaussians, scaled by ``update.momentum``."""


@dataclass(frozen=True)
class Prediction(Effect):
    """Starts an update from the previous motion."""

    def refusal(self, settings: Settings) -> tuple[str, str] | None:
        """Returns a refusal if all effects whose parameters are extrapolated are pinned off."""
        carried = CLUSTERS if settings.update.momentum == 0 else CLUSTERS + OWN
        if any(settings.effects.get(name) != "off" for name in carried):
            return None
        return f"{' and '.join(carried)} are 'off'", "set at least one of them to 'auto'"

    def register(self, builder: PlanBuilder) -> None:
        """Lets the update start from the previous motion."""
        builder.plan.freedom = replace(builder.plan.freedom, prediction=True)


EFFECT = Prediction(
    name="prediction",
    group=EffectGroup.MOTION,
    description="An update starts from the motion of the previous frame if that fits the new frame better.",
    disambiguation="It affects only the starting point; the images determine the result.",
    cost="one comparison of half-size images of four views per update",
)
