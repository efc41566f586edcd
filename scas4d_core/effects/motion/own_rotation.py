"""ΔR of each Gaussian (paper, equation 7). Kernel: ``kernels.deltas``; reference: ``engines.torch.deformation``."""

from __future__ import annotations

from scas4d_core.effects.effect import Group
from scas4d_core.effects.motion.free_columns import FreeColumns

EFFECT = FreeColumns(
    name="own_rotation",
    group=Group.MOTION,
    says="Each Gaussian may turn beside its clusters.",
    gauge="It begins once all layers of clusters have begun, at a small rate: it finds what they leave.",
    cost="a third of the step of Adam over 9 numbers of each moving Gaussian; one off saves no time, all three 1 %",
)
