"""Log scale Δs per Gaussian (paper, equation 7).

Kernel: ``kernels.deltas``; reference: ``engines.torch.deformation``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from scas4d_core.effects.effect import EffectGroup, refusal_at_zero
from scas4d_core.effects.motion.free_columns import FreeColumns

if TYPE_CHECKING:
    from scas4d_core.settings import Settings


@dataclass(frozen=True)
class OwnScale(FreeColumns):
    """Enables the log scale Δs, which is learnt with the learning rate ``rate_scale``."""

    def refusal(self, settings: Settings) -> tuple[str, str] | None:
        """Returns a refusal if ``rate_scale`` is 0."""
        return refusal_at_zero(settings, "rate_scale")


EFFECT = OwnScale(
    name="own_scale",
    group=EffectGroup.MOTION,
    description="Each Gaussian's axes may grow and shrink.",
    disambiguation="Axis lengths are limited, and changes are learnt last and slowly.",
    cost="1% of an update, together with own_position and own_rotation",
)
