"""Limit on the axis lengths of Gaussians (paper, scale loss).

Kernel: ``kernels.deltas``; reference: ``engines.torch.losses.scale_loss``.
"""

from __future__ import annotations

from dataclasses import dataclass

from scas4d_core.effects.effect import Effect, EffectGroup
from scas4d_core.update.parts import PlanBuilder


@dataclass(frozen=True)
class AxisLength(Effect):
    """The axis length term of the loss, weighted by ``weights.scale``."""

    def register(self, builder: PlanBuilder) -> None:
        """Adds the loss term to the plan, with its weight from the settings."""
        builder.plan.axis_length = builder.update.weights.scale


EFFECT = AxisLength(
    name="axis_length",
    group=EffectGroup.COHERENCE,
    description="Axes longer than both 2 cm and their length in frame 0 are penalized.",
    disambiguation="The limits come from frame 0.",
    cost="none measurable: it is part of the cascade's backward pass",
    positive_setting="weights.scale",
)
