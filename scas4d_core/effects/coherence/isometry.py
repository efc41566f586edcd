"""Isometry term between neighbours (Dynamic3DGaussians).

Kernel: ``kernels.neighbour_terms``; reference: ``engines.torch.losses.isometry_loss``.
"""

from __future__ import annotations

from scas4d_core.effects.coherence.neighbour_term import NeighbourTerm
from scas4d_core.effects.effect import EffectGroup

EFFECT = NeighbourTerm(
    name="isometry",
    group=EffectGroup.COHERENCE,
    description="Neighbours keep the distances that they had in frame 0: objects bend but do not tear.",
    disambiguation="It uses the distances of frame 0 and ignores rotations.",
    cost="one pass over 4,000 Gaussians and their neighbours per iteration, shared with rigidity and rotation",
    positive_setting="weights.isometry",
)
