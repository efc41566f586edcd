"""Cluster rotation r (paper, equation 6).

Kernel: ``kernels.cascade``; reference: ``engines.torch.deformation``.
"""

from __future__ import annotations

from scas4d_core.effects.effect import EffectGroup
from scas4d_core.effects.motion.free_columns import ClusterColumns

EFFECT = ClusterColumns(
    name="cluster_rotation",
    group=EffectGroup.MOTION,
    description="Clusters rotate: the parts of an object, and the parts of these.",
    disambiguation="About the cluster's centroid, beside a translation; coarse layers learn first.",
    cost="none measurable: off saves three numbers per cluster in Adam's step, not the cascade",
)
