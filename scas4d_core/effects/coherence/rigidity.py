"""Rigidity term between neighbours (Dynamic3DGaussians).

Kernel: ``kernels.neighbour_terms``; reference: ``engines.torch.losses.rigidity_loss``.
"""

from __future__ import annotations

from scas4d_core.effects.coherence.neighbour_term import NeighbourTerm
from scas4d_core.effects.effect import EffectGroup

EFFECT = NeighbourTerm(
    name="rigidity",
    group=EffectGroup.COHERENCE,
    description="Neighbours keep the relative positions that they had in the previous frame.",
    disambiguation="It constrains motion, not colour, so no other effect competes with it.",
    cost="one pass over 4,000 Gaussians and their neighbours per iteration, shared with isometry and rotation",
    positive_setting="weights.rigidity",
)
