"""The parameters of a deformation that are free in an update; all others stay at the identity."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Freedom:
    """The free columns of the tables of clusters and of the Gaussians' own deltas. What is not free stays exactly 0.

    Attributes:
        cluster_rotation, cluster_translation, cluster_scaling: r, t, c and s of the clusters of all layers.
        own_position, own_rotation, own_scale: Δp, ΔR, Δs of each Gaussian.
        prediction: whether the free ones start from the motion before, else from 0.

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
