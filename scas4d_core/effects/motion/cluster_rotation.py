"""Rotation of clusters, r (paper, equation 6).

Kernel: ``kernels.cascade``; reference: ``engines.torch.deformation``.
"""

from __future__ import annotations

from scas4d_core.effects.effect import Group
from scas4d_core.effects.motion.free_columns import ClusterColumns

EFFECT = ClusterColumns(
    name="cluster_rotation",
    group=Group.MOTION,
    says="Clusters turn: the parts of a thing, and the parts of these.",
    gauge="About the middle of the cluster, beside a translation; coarse layers begin before fine ones.",
    cost="none that can be measured: off saves three numbers of each cluster in the step of Adam, not the cascade",
)
