"""Position-dependent cluster scaling with c and s (paper, equation 6).

Kernel: ``kernels.cascade``; reference: ``engines.torch.deformation``.
"""

from __future__ import annotations

from scas4d_core.effects.effect import EffectGroup
from scas4d_core.effects.motion.free_columns import ClusterColumns

EFFECT = ClusterColumns(
    name="cluster_scaling",
    group=EffectGroup.MOTION,
    description="Clusters stretch and shrink by a factor that varies within the cluster, for objects that bend, "
    "breathe or swing.",
    disambiguation="The scaling is about the cluster's centroid; isometry limits it where neighbours keep their "
    "distances.",
    cost="none measurable: turning it off saves four values per cluster in the Adam step, but not the cascade",
)
