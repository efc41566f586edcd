"""Cluster translation t (paper, equation 6).

Kernel: ``kernels.cascade``; reference: ``engines.torch.deformation``.
"""

from __future__ import annotations

from scas4d_core.effects.effect import EffectGroup
from scas4d_core.effects.motion.free_columns import ClusterColumns

EFFECT = ClusterColumns(
    name="cluster_translation",
    group=EffectGroup.MOTION,
    description="Clusters translate: whole objects first, then their parts.",
    disambiguation="It moves the cluster's centroid, separate from the rotation; coarse layers learn first.",
    cost="none measurable: turning it off saves three values per cluster in the Adam step, but not the cascade",
)
