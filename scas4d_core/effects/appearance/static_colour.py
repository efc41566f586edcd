"""RGB colours of static Gaussians, learnt from the images (Dynamic3DGaussians)."""

from __future__ import annotations

from dataclasses import dataclass

from scas4d_core.effects.effect import Effect, EffectGroup
from scas4d_core.update.parts import PlanBuilder


@dataclass(frozen=True)
class StaticColour(Effect):
    """Learns the RGB colours of static Gaussians with the learning rate ``rate_static_colour``."""

    def register(self, builder: PlanBuilder) -> None:
        """Makes the colours of static Gaussians learnable, which requires full images."""
        builder.plan.learns_colours().static = True
        builder.plan.full_images = True


EFFECT = StaticColour(
    name="static_colour",
    group=EffectGroup.APPEARANCE,
    description="If pinned on, the colours of static Gaussians follow the images in every iteration.",
    disambiguation="The mean absolute colour change is a loss term, so colours do not compensate for motion or gains.",
    cost="full-image rendering and one Adam step over RGB per iteration",
    auto=True,
    positive_setting="rate_static_colour",
)
