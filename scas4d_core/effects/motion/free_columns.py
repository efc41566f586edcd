"""Base classes of the motion effects, each of which enables parameters of the deformation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from scas4d_core.effects.effect import Effect, effect
from scas4d_core.update.parts import PlanBuilder

if TYPE_CHECKING:
    from scas4d_core.settings import Settings

MOVES = (
    "cluster_rotation",
    "cluster_translation",
    "cluster_scaling",
    "own_position",
    "own_rotation",
    "own_scale",
)
"""Effects that can change the position or shape of Gaussians; each name is also a field of ``Freedom``."""


def may_be_on(name: str, settings: Settings) -> bool:
    """Returns whether the settings neither pin an effect off nor contradict it."""
    return settings.effects.get(name) != "off" and effect(name).refusal(settings) is None


@dataclass(frozen=True)
class FreeColumns(Effect):
    """An effect that enables the parameters of the same name (``engines.freedom.Freedom``)."""

    def requirement(self, settings: Settings) -> tuple[str, str] | None:
        """Returns a requirement if nothing could move without this effect."""
        if any(may_be_on(name, settings) for name in MOVES):
            return None
        return "no effect could move clusters or Gaussians", f"set at least one of {', '.join(MOVES)} to 'auto'"

    def register(self, builder: PlanBuilder) -> None:
        """Enables the parameters in the plan."""
        builder.plan.freedom = replace(builder.plan.freedom, **{self.name: True})


@dataclass(frozen=True)
class ClusterColumns(FreeColumns):
    """An effect that enables parameters of the clusters."""

    def refusal(self, settings: Settings) -> tuple[str, str] | None:
        """Returns a refusal if ``update.clusters`` is empty."""
        if settings.update.clusters:
            return None
        return "update.clusters is empty", "set the number of clusters per layer, such as (64, 320, 1280)"
