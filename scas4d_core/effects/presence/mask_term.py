"""Mask term: rendered labels match the masks.

Kernel: ``kernels.image_loss``; reference: ``engines.torch.losses.image_loss``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from scas4d_core.effects.effect import Effect, EffectGroup
from scas4d_core.update.parts import PlanBuilder

if TYPE_CHECKING:
    from scas4d_core.settings import Settings


@dataclass(frozen=True)
class MaskTerm(Effect):
    """The loss term ``weights.mask`` or ``weights.mask_alone``, in frames with masks."""

    def refusal(self, settings: Settings) -> tuple[str, str] | None:
        """Refused if masks are not used, or if both weights are 0."""
        update = settings.update
        if not update.use_masks:
            return "update.use_masks is false", "give true"
        if update.weights.mask > 0 or update.weights.mask_alone > 0:
            return None
        return "update.weights.mask and update.weights.mask_alone are 0", "give one of them a weight above 0"

    def register(self, builder: PlanBuilder) -> None:
        """Adds the term with its weight."""
        from scas4d_core.update.schedule import mask_weight  # deferred import, because it loads the kernels

        builder.plan.mask = mask_weight(builder.update, len(builder.hierarchy.rows), int(builder.first.present.sum()))


EFFECT = MaskTerm(
    name="mask_term",
    group=EffectGroup.PRESENCE,
    description="With masks, moving and static Gaussians must cover the pixels that the masks give them.",
    disambiguation="Labels come from frame 0 and are no parameter: the term moves Gaussians, and relabels none.",
    cost="a fourth channel beside RGB, forward and backward; without masks nothing",
    without_masks=False,
)
