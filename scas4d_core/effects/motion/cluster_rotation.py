"""Cluster rotation r (paper, equation 6).

Kernel: ``kernels.cascade``; reference: ``engines.torch.deformation``.
"""

from __future__ import annotations

from scas4d_core.effects.effect import EffectGroup
from scas4d_core.effects.motion.free_columns import ClusterColumns

EFFECT = ClusterColumns(
    name="cluster_rotation",
    group=EffectGroup.MOTION,
    description="Clusters rotate: the parts of an object, and smaller parts within them.",
    disambiguation="The rotation is about the cluster's centroid, separate from the translation; coarse layers learn "
    "first.",
    cost="none measurable: turning it off saves three values per cluster in the Adam step, but not the cascade",
)
