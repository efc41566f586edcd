"""Position-dependent scaling of clusters, c and s (paper, equation 6).

Kernel: ``kernels.cascade``; reference: ``engines.torch.deformation``.
"""

from __future__ import annotations

from scas4d_core.effects.effect import Group
from scas4d_core.effects.motion.free_columns import ClusterColumns

EFFECT = ClusterColumns(
    name="cluster_scaling",
    group=Group.MOTION,
    says="Clusters stretch and shrink, by another factor in each place: things that bend, breathe and swing.",
    gauge="About the middle of the cluster; isometry holds it back where neighbours keep their distance.",
    cost="none that can be measured: off saves four numbers of each cluster in the step of Adam, not the cascade",
)
