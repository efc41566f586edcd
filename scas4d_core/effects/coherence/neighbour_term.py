"""Effects that add a loss term between neighbours (Dynamic3DGaussians).

Kernel: ``kernels.neighbour_terms``; references: ``engines.torch.losses``.
"""

from __future__ import annotations

from dataclasses import dataclass

from scas4d_core.effects.effect import Effect
from scas4d_core.update.parts import PlanBuilder


@dataclass(frozen=True)
class NeighbourTerm(Effect):
    """A term of the loss between neighbours, with the weight of the same name in the settings and in the plan."""

    def register(self, builder: PlanBuilder) -> None:
        """Adds the loss term to the plan, with its weight from the settings."""
        builder.plan.neighbour_terms = True
        setattr(builder.plan, self.name, getattr(builder.update.weights, self.name))
