"""Isometry term between neighbours (Dynamic3DGaussians).

Kernel: ``kernels.neighbour_terms``; reference: ``engines.torch.losses.isometry_loss``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from scas4d_core.effects.effect import Effect, EffectGroup, refusal_at_zero
from scas4d_core.update.parts import PlanBuilder

if TYPE_CHECKING:
    from scas4d_core.settings import Settings


@dataclass(frozen=True)
class Isometry(Effect):
    """The isometry term of the loss, weighted by ``weights.isometry``."""

    def refusal(self, settings: Settings) -> tuple[str, str] | None:
        """Returns a refusal if ``weights.isometry`` is 0."""
        return refusal_at_zero(settings, "weights.isometry")

    def register(self, builder: PlanBuilder) -> None:
        """Adds the loss term to the plan, with its weight from the settings."""
        builder.plan.neighbour_terms = True
        builder.plan.isometry = builder.update.weights.isometry


EFFECT = Isometry(
    name="isometry",
    group=EffectGroup.COHERENCE,
    description="Neighbours keep the distances that they had in frame 0: objects bend but do not tear.",
    disambiguation="It uses the distances of frame 0 and ignores rotations.",
    cost="one pass over 4,000 Gaussians and their neighbours per iteration, shared with rigidity and rotation",
)
