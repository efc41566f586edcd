"""Log scale Δs per Gaussian (paper, equation 7).

Kernel: ``kernels.deltas``; reference: ``engines.torch.deformation``.
"""

from __future__ import annotations

from scas4d_core.effects.effect import EffectGroup
from scas4d_core.effects.motion.free_columns import FreeColumns

EFFECT = FreeColumns(
    name="own_scale",
    group=EffectGroup.MOTION,
    description="Each Gaussian's axes may grow and shrink.",
    disambiguation="Axis lengths are limited, and changes are learnt last and slowly.",
    cost="1% of an update, together with own_position and own_rotation",
    positive_setting="rate_scale",
)
