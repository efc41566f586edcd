"""Translation of clusters, t (paper, equation 6).

Kernel: ``kernels.cascade``; reference: ``engines.torch.deformation``.
"""

from __future__ import annotations

from scas4d_core.effects.effect import Group
from scas4d_core.effects.motion.free_columns import ClusterColumns

EFFECT = ClusterColumns(
    name="cluster_translation",
    group=Group.MOTION,
    says="Clusters shift: things as a whole, then their parts.",
    gauge="Of the middle of the cluster, beside a rotation; coarse layers begin before fine ones.",
    cost="none that can be measured: off saves three numbers of each cluster in the step of Adam, not the cascade",
)
