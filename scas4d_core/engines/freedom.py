"""Selection of the free parameters of a deformation. All other parameters stay at the identity."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Freedom:
    """Selection of the columns of the cluster tables and deltas that are optimized. All other columns stay exactly 0.

    Attributes:
        cluster_rotation: whether r is free for the clusters in all layers.
        cluster_translation: whether t is free for the clusters in all layers.
        cluster_scaling: whether c and s are free for the clusters in all layers.
        own_position, own_rotation, own_scale: whether Δp, ΔR and Δs of each Gaussian are free.
        prediction: whether to initialize the free parameters with the previous motion instead of 0.

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
