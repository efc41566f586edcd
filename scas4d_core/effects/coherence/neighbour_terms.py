"""The part that rigidity, isometry and rotation share: one kernel computes all three in a pass over the pairs."""

from __future__ import annotations

import numpy as np

from scas4d_core.effects.parts import Part, PartsBuilder, Work


class NeighbourTerms(Part):
    """Terms between neighbours; a term that no effect asked for has strength 0.

    Attributes:
        strengths: weights of rigidity, isometry and rotation.
    """

    known_to_devices = True

    def __init__(self, builder: PartsBuilder) -> None:
        self.strengths = [0.0, 0.0, 0.0]

    def loss(self, work: Work) -> float:
        """The terms of the iteration's sample; the cascade's backward takes their gradient (``neighbour_losses``)."""
        rigidity, isometry, rotation = self.strengths
        parts = work.deformation.neighbour_losses(work.sample, (rigidity, isometry, rotation))
        return float(np.dot(self.strengths, parts))
