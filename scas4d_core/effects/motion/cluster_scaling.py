"""Position-dependent cluster scaling with c and s (paper, equation 6).

Kernel: ``kernels.cascade``; reference: ``engines.torch.deformation``.
"""

from __future__ import annotations

from scas4d_core.effects.effect import EffectGroup
from scas4d_core.effects.motion.free_columns import ClusterColumns

EFFECT = ClusterColumns(
    name="cluster_scaling",
    group=EffectGroup.MOTION,
    description="Clusters stretch and shrink, by a factor that varies within a cluster: objects that bend, breathe "
    "or swing.",
    disambiguation="About the cluster's centroid; isometry limits it where neighbours keep their distance.",
    cost="none measurable: off saves four numbers per cluster in Adam's step, not the cascade",
)
