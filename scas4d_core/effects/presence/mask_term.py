"""Mask term: penalizes rendered labels that differ from the masks.

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
    """The mask term of the loss in frames with masks, weighted by ``weights.mask`` or ``weights.mask_alone``."""

    def refusal(self, settings: Settings) -> tuple[str, str] | None:
        """Returns a refusal if masks are not used, or if both weights are 0."""
        update = settings.update
        if not update.use_masks:
            return "update.use_masks is false", "set it to true"
        if update.weights.mask > 0 or update.weights.mask_alone > 0:
            return None
        return "update.weights.mask and update.weights.mask_alone are 0", "set at least one of them above 0"

    def register(self, builder: PlanBuilder) -> None:
        """Adds the loss term to the plan, with its weight from the settings."""
        from scas4d_core.update.schedule import mask_weight  # deferred import, because it loads the kernels

        builder.plan.mask = mask_weight(builder.update, len(builder.hierarchy.rows), int(builder.first.present.sum()))


EFFECT = MaskTerm(
    name="mask_term",
    group=EffectGroup.PRESENCE,
    description="With masks, moving and static Gaussians must cover the pixels that the masks assign to them.",
    disambiguation="Labels are fixed in frame 0 and are not parameters: the term moves Gaussians, but never relabels "
    "them.",
    cost="a fourth channel in addition to RGB, forward and backward; no cost without masks",
    without_masks=False,
)
