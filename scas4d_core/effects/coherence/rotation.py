"""Rotation term between neighbours (Dynamic3DGaussians).

Kernel: ``kernels.neighbour_terms``; reference: ``engines.torch.losses.rotation_loss``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from scas4d_core.effects.effect import Effect, EffectGroup, refusal_at_zero
from scas4d_core.update.parts import PlanBuilder

if TYPE_CHECKING:
    from scas4d_core.settings import Settings


@dataclass(frozen=True)
class Rotation(Effect):
    """The rotation term of the loss, weighted by ``weights.rotation``."""

    def refusal(self, settings: Settings) -> tuple[str, str] | None:
        """Returns a refusal if ``weights.rotation`` is 0."""
        return refusal_at_zero(settings, "weights.rotation")

    def register(self, builder: PlanBuilder) -> None:
        """Adds the loss term to the plan, with its weight from the settings."""
        builder.plan.neighbour_terms = True
        builder.plan.rotation = builder.update.weights.rotation


EFFECT = Rotation(
    name="rotation",
    group=EffectGroup.COHERENCE,
    description="Neighbours rotate by similar amounts.",
    disambiguation="It compares rotations since the previous frame.",
    cost="one pass over 4,000 Gaussians and their neighbours per iteration, shared with rigidity and isometry",
)
