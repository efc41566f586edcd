"""Colours of what moves: RGB of each Gaussian follows the pictures (Dynamic3DGaussians)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from scas4d_core.effects.effect import Effect, Group, refused_at_zero
from scas4d_core.update.parts import PlanBuilder

if TYPE_CHECKING:
    from scas4d_core.settings import Settings


@dataclass(frozen=True)
class MovingColour(Effect):
    """RGB of the Gaussians that move, at the rate ``rate_colour``."""

    def refused(self, settings: Settings) -> tuple[str, str] | None:
        """Refused with a rate of 0."""
        return refused_at_zero(settings, "rate_colour")

    def join(self, builder: PlanBuilder) -> None:
        """Frees their colours."""
        builder.plan.learns_colours().moving = True


EFFECT = MovingColour(
    name="moving_colour",
    group=Group.APPEARANCE,
    says="The colours of what moves follow the pictures, slowly: shading changes as things turn.",
    gauge="The mean absolute change of all colours is a term: what moves or a gain explains is not put into colours.",
    cost="one step of Adam over RGB an iteration, shared with the other colours",
)
