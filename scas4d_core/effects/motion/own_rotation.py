"""Rotation ΔR per Gaussian (paper, equation 7).

Kernel: ``kernels.deltas``; reference: ``engines.torch.deformation``.
"""

from __future__ import annotations

from scas4d_core.effects.effect import EffectGroup
from scas4d_core.effects.motion.free_columns import FreeColumns

EFFECT = FreeColumns(
    name="own_rotation",
    group=EffectGroup.MOTION,
    description="Each Gaussian may rotate relative to its clusters.",
    disambiguation="It is learnt last and slowly, so it captures only motion that the clusters do not explain.",
    cost="1% of an update, together with own_position and own_scale",
)
