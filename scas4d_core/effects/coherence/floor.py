"""The floor: nothing that moves sinks into it (Dynamic3DGaussians' floor loss, for a floor of any pose).

Numpy; its twin is ``losses.floor_loss``. Only a scene that names a floor has the term.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import WorldFrame
from scas4d_core.effects.effect import Effect, Group
from scas4d_core.effects.parts import Part, PartsBuilder, Work

if TYPE_CHECKING:
    from torch import Tensor

    from scas4d_core.settings import Settings

Array = NDArray[np.float32]
Plane = tuple[float, float, float, float]

FLOOR_WEIGHT = 2.0
"""Beside 1 for the image loss (Dynamic3DGaussians). A scene that wants no such term names no floor."""


def floor_inside(plane: Sequence[float], world: WorldFrame) -> Plane:
    """A plane (a, b, c, d) of the user's world as the inside world has it.

    Positive values of a·x + b·y + c·z + d lie below the floor; inside, they are metres.

    Raises:
        ValueError: (a, b, c) is no direction.
    """
    normal = np.asarray(plane[:3], dtype=np.float64)
    length = float(np.linalg.norm(normal))
    if not length > 0:
        raise ValueError(f"floor {tuple(plane)} has no direction; give (a, b, c, d) with (a, b, c) pointing down")
    normal = normal / length
    offset = (float(normal @ world.origin) + plane[3] / length) * world.metres_per_unit
    return float(normal[0]), float(normal[1]), float(normal[2]), offset


def floor_term(plane: Plane, means: Array, rows: NDArray[np.int64], weight: float, g_means: Array) -> float:
    """The weighted mean depth below the floor; its gradient is added to ``g_means``.

    Args:
        plane: from ``floor_inside``. means [N, 3] metres. rows: [M] the moving Gaussians.
        g_means: [N, 3], added to.
    """
    if len(rows) == 0:
        return 0.0
    normal = np.array(plane[:3], np.float32)
    depth = means[rows] @ normal + np.float32(plane[3])
    below = rows[depth > 0]
    g_means[below] += np.float32(weight / len(rows)) * normal
    return float(weight * np.maximum(depth, 0).mean())


class FloorPart(Part):
    """The term in the updates of a scene."""

    def __init__(self, plane: Plane, rows: NDArray[np.int64], weight: float) -> None:
        self._plane, self._rows, self._weight = plane, rows, weight

    def loss(self, work: Work) -> float:
        """See ``floor_term``."""
        return floor_term(self._plane, work.deformation.means, self._rows, self._weight, work.gradients.means)

    def twin(self, means: Tensor) -> Tensor:
        """See ``losses.floor_loss``."""
        from scas4d_core.torch_backend.losses import floor_loss  # torch is loaded only where it is used

        return self._weight * floor_loss(means, self._plane)


@dataclass(frozen=True)
class Floor(Effect):
    """The term for the plane ``scene.floor``."""

    def refused(self, settings: Settings) -> tuple[str, str] | None:
        """Refused without a plane."""
        if settings.scene.floor is None:
            return "the scene names no floor", "give scene.floor, a plane (a, b, c, d)"
        return None

    def join(self, builder: PartsBuilder) -> None:
        """Adds the term."""
        assert builder.scene.floor is not None
        builder.parts.append(FloorPart(builder.scene.floor, builder.hierarchy.rows, FLOOR_WEIGHT))


EFFECT = Floor(
    name="floor",
    group=Group.COHERENCE,
    says="What moves stays above the floor that the scene names.",
    gauge="A plane in the user's world.",
    cost="one dot product for each moving Gaussian an iteration",
)
