"""Rigidity term between neighbours (Dynamic3DGaussians).

Kernel: ``kernels.neighbour_terms``; reference: ``engines.torch.losses.rigidity_loss``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from scas4d_core.effects.effect import Effect, EffectGroup, refusal_at_zero
from scas4d_core.update.parts import PlanBuilder

if TYPE_CHECKING:
    from scas4d_core.settings import Settings


@dataclass(frozen=True)
class Rigidity(Effect):
    """The rigidity term of the loss, weighted by ``weights.rigidity``."""

    def refusal(self, settings: Settings) -> tuple[str, str] | None:
        """Returns a refusal if ``weights.rigidity`` is 0."""
        return refusal_at_zero(settings, "weights.rigidity")

    def register(self, builder: PlanBuilder) -> None:
        """Adds the loss term to the plan, with its weight from the settings."""
        builder.plan.neighbour_terms = True
        builder.plan.rigidity = builder.update.weights.rigidity


EFFECT = Rigidity(
    name="rigidity",
    group=EffectGroup.COHERENCE,
    description="Neighbours keep the relative positions that they had in the previous frame.",
    disambiguation="It constrains motion, not colour, so no other effect competes with it.",
    cost="one pass over 4,000 Gaussians and their neighbours per iteration, shared with isometry and rotation",
)
