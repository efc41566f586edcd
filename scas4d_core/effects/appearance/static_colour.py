"""Colours of static Gaussians: their RGB follows the images (Dynamic3DGaussians)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from scas4d_core.effects.effect import Effect, EffectGroup, refusal_at_zero
from scas4d_core.update.parts import PlanBuilder

if TYPE_CHECKING:
    from scas4d_core.settings import Settings


@dataclass(frozen=True)
class StaticColour(Effect):
    """RGB of the static Gaussians, learnt at the rate ``rate_static_colour``."""

    def refusal(self, settings: Settings) -> tuple[str, str] | None:
        """Refused if the rate is 0."""
        return refusal_at_zero(settings, "rate_static_colour")

    def register(self, builder: PlanBuilder) -> None:
        """Makes their colours learnable."""
        builder.plan.learns_colours().static = True
        builder.plan.full_images = True


EFFECT = StaticColour(
    name="static_colour",
    group=EffectGroup.APPEARANCE,
    description="The colours of static Gaussians follow the pictures in every iteration; only where it is pinned on.",
    disambiguation="The mean absolute colour change is a loss term: motion and gains are not absorbed by colours.",
    cost="full pictures are rendered, and one Adam step over RGB per iteration",
    auto=True,
)
