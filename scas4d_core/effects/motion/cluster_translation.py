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
    disambiguation="Of the cluster's centroid, beside a rotation; coarse layers learn first.",
    cost="none measurable: off saves three numbers per cluster in Adam's step, not the cascade",
)
