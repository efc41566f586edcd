"""Rotation term between neighbours (Dynamic3DGaussians).

Kernel: ``kernels.neighbour_terms``; reference: ``engines.torch.losses.rotation_loss``.
"""

from __future__ import annotations

from scas4d_core.effects.coherence.neighbour_term import NeighbourTerm
from scas4d_core.effects.effect import EffectGroup

EFFECT = NeighbourTerm(
    name="rotation",
    group=EffectGroup.COHERENCE,
    description="Neighbours rotate by similar amounts.",
    disambiguation="It compares rotations since the previous frame.",
    cost="one pass over 4,000 Gaussians and their neighbours per iteration, shared with rigidity and isometry",
    positive_setting="weights.rotation",
)
