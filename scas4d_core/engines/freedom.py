"""The free parameters of a deformation; all others stay at the identity."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Freedom:
    """Which columns of the cluster tables and of the per-Gaussian deltas are free. The others stay exactly 0.

    Attributes:
        cluster_rotation, cluster_translation, cluster_scaling: r, t, c and s of the clusters of all layers.
        own_position, own_rotation, own_scale: Δp, ΔR, Δs of each Gaussian.
        prediction: whether the free parameters start from the previous motion instead of 0.

    >>> Freedom(own_scale=True).clusters
    False
    """

    cluster_rotation: bool = False
    cluster_translation: bool = False
    cluster_scaling: bool = False
    own_position: bool = False
    own_rotation: bool = False
    own_scale: bool = False
    prediction: bool = False

    @property
    def clusters(self) -> bool:
        """True where anything of the clusters is free."""
        return self.cluster_rotation or self.cluster_translation or self.cluster_scaling
