"""The interface that the motion effects share: each frees parameters of the deformation."""

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
"""The effects by which anything can change its place or shape; each is also the name of its field of ``Freedom``."""


def may_be_on(name: str, settings: Settings) -> bool:
    """True where the settings neither pin an effect off nor contradict it."""
    return settings.effects.get(name) != "off" and effect(name).refusal(settings) is None


@dataclass(frozen=True)
class FreeColumns(Effect):
    """An effect that frees the parameters of its name (``engines.freedom.Freedom``)."""

    def requirement(self, settings: Settings) -> tuple[str, str] | None:
        """Refused where nothing at all could move."""
        if any(may_be_on(name, settings) for name in MOVES):
            return None
        return "no motion of clusters and of Gaussians is left", f"leave one of {', '.join(MOVES)} 'auto'"

    def register(self, builder: PlanBuilder) -> None:
        """Frees them."""
        builder.plan.freedom = replace(builder.plan.freedom, **{self.name: True})


@dataclass(frozen=True)
class ClusterColumns(FreeColumns):
    """An effect that frees parameters of the clusters."""

    def refusal(self, settings: Settings) -> tuple[str, str] | None:
        """Refused without clusters."""
        if settings.update.clusters:
            return None
        return "update.clusters is empty", "give the numbers of clusters, as (64, 320, 1280)"
