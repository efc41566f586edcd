"""The free parameters of a deformation; all others stay at the identity."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Freedom:
    """Flags for the free columns of the cluster tables and per-Gaussian deltas. All other columns stay exactly 0.

    Attributes:
        cluster_rotation, cluster_translation, cluster_scaling: r, t, and c with s of the clusters of all layers.
        own_position, own_rotation, own_scale: Δp, ΔR, Δs of each Gaussian.
        prediction: whether the free parameters are initialized with the previous motion instead of 0.

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
        """Whether any cluster parameter is free."""
        return self.cluster_rotation or self.cluster_translation or self.cluster_scaling
