"""Colours of what stands: RGB of each Gaussian follows the pictures (Dynamic3DGaussians)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from scas4d_core.effects.effect import Effect, Group, refused_at_zero
from scas4d_core.update.parts import PlanBuilder

if TYPE_CHECKING:
    from scas4d_core.settings import Settings


@dataclass(frozen=True)
class StandingColour(Effect):
    """RGB of the Gaussians that stand, at the rate ``rate_colour_standing``."""

    def refused(self, settings: Settings) -> tuple[str, str] | None:
        """Refused with a rate of 0."""
        return refused_at_zero(settings, "rate_colour_standing")

    def join(self, builder: PlanBuilder) -> None:
        """Frees their colours."""
        builder.plan.learns_colours().standing = True
        builder.plan.whole_pictures = True


EFFECT = StandingColour(
    name="standing_colour",
    group=Group.APPEARANCE,
    says="The colours of static Gaussians follow the pictures in every iteration; only where it is pinned on.",
    gauge="The mean absolute colour change is a loss term: motion and gains are not absorbed by colours.",
    cost="full pictures are rendered, and one Adam step over RGB per iteration",
    auto=True,
)
