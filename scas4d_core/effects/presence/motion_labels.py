"""Labels of moving Gaussians, learnt from changed pixels if there are no masks; all other Gaussians are static.

``motion_mask`` computes the labels between two updates.
"""

from __future__ import annotations

from dataclasses import dataclass

from scas4d_core.effects.effect import Effect, EffectGroup
from scas4d_core.update.parts import PlanBuilder


@dataclass(frozen=True)
class MotionLabels(Effect):
    """Learns labels from motion, in scenes without masks."""

    def register(self, builder: PlanBuilder) -> None:
        """Enables the learning of labels between updates."""
        builder.plan.learns_labels = True


EFFECT = MotionLabels(
    name="motion_labels",
    group=EffectGroup.PRESENCE,
    description="Without masks, only Gaussians that most cameras have seen in changed pixels move.",
    disambiguation="A Gaussian that has moved once may always move: labels are only added, never removed.",
    cost="a comparison of each view with the previous frame, which takes less time than static Gaussians save",
)
