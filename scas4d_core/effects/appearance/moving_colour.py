"""RGB colours of moving Gaussians, learnt from the images (Dynamic3DGaussians)."""

from __future__ import annotations

from dataclasses import dataclass

from scas4d_core.effects.effect import Effect, EffectGroup
from scas4d_core.update.parts import PlanBuilder


@dataclass(frozen=True)
class MovingColour(Effect):
    """Learns the RGB colours of moving Gaussians with the learning rate ``rate_colour``."""

    def register(self, builder: PlanBuilder) -> None:
        """Makes the colours of moving Gaussians learnable."""
        builder.plan.learns_colours().moving = True


EFFECT = MovingColour(
    name="moving_colour",
    group=EffectGroup.APPEARANCE,
    description="The colours of moving Gaussians follow the images slowly, because shading changes as objects rotate.",
    disambiguation="The mean absolute colour change is a loss term, so colours do not compensate for motion or gains.",
    cost="one Adam step over RGB per iteration, shared with the other colours",
    positive_setting="rate_colour",
)
