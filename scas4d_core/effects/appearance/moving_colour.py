"""Colours of moving Gaussians: their RGB follows the images (Dynamic3DGaussians)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from scas4d_core.effects.effect import Effect, EffectGroup, refusal_at_zero
from scas4d_core.update.parts import PlanBuilder

if TYPE_CHECKING:
    from scas4d_core.settings import Settings


@dataclass(frozen=True)
class MovingColour(Effect):
    """RGB of the moving Gaussians, learnt at the rate ``rate_colour``."""

    def refusal(self, settings: Settings) -> tuple[str, str] | None:
        """Refused if the rate is 0."""
        return refusal_at_zero(settings, "rate_colour")

    def register(self, builder: PlanBuilder) -> None:
        """Makes their colours learnable."""
        builder.plan.learns_colours().moving = True


EFFECT = MovingColour(
    name="moving_colour",
    group=EffectGroup.APPEARANCE,
    description="The colours of moving Gaussians follow the pictures slowly: shading changes as objects rotate.",
    disambiguation="The mean absolute colour change is a loss term: motion and gains are not absorbed by colours.",
    cost="one Adam step over RGB per iteration, shared with the other colours",
)
