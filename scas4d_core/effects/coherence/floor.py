"""Floor term: keeps moving Gaussians above the floor (floor loss of Dynamic3DGaussians, for any plane).

Kernel: ``engines.cpu.floor``; reference: ``losses.floor_loss``. The term is used only in scenes with a floor plane.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from scas4d_core.cameras import WorldFrame
from scas4d_core.effects.effect import Effect, EffectGroup
from scas4d_core.engines.plan import Plane
from scas4d_core.update.parts import PlanBuilder

if TYPE_CHECKING:
    from scas4d_core.settings import Settings

FLOOR_WEIGHT = 2.0
"""Weight of the term (Dynamic3DGaussians); the image loss has weight 1. To disable the term, leave the floor unset."""


def floor_inside(plane: Sequence[float], world: WorldFrame) -> Plane:
    """Converts a plane (a, b, c, d) from the user's world to the internal world.

    Points with a·x + b·y + c·z + d > 0 are below the floor. In the internal world, this value is the depth below the
    floor in metres.

    Args:
        plane: plane (a, b, c, d) in the user's world.
        world: position and scale of the internal world.

    Raises:
        ValueError: if (a, b, c) has zero length.
    """
    normal = np.asarray(plane[:3], dtype=np.float64)
    length = float(np.linalg.norm(normal))
    if not length > 0:
        raise ValueError(f"floor {tuple(plane)} has a zero normal; use (a, b, c, d) with (a, b, c) pointing down")
    normal = normal / length
    offset = (float(normal @ world.origin) + plane[3] / length) * world.metres_per_unit
    return float(normal[0]), float(normal[1]), float(normal[2]), offset


@dataclass(frozen=True)
class Floor(Effect):
    """The floor term of the loss, for the plane ``scene.floor``."""

    def refusal(self, settings: Settings) -> tuple[str, str] | None:
        """Returns a refusal if the scene has no floor plane."""
        if settings.scene.floor is None:
            return "the scene has no floor plane", "set scene.floor to a plane (a, b, c, d)"
        return None

    def register(self, builder: PlanBuilder) -> None:
        """Adds the floor term to the plan."""
        assert builder.scene.floor is not None
        builder.plan.floor, builder.plan.floor_weight = builder.scene.floor, FLOOR_WEIGHT


EFFECT = Floor(
    name="floor",
    group=EffectGroup.COHERENCE,
    description="Moving Gaussians stay above the floor plane of the scene.",
    disambiguation="The plane is given in the user's world.",
    cost="one dot product per moving Gaussian and iteration",
)
