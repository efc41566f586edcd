"""Bending: where things bend all over, as cloth does, neighbours turn each in their own way.

The term ``rotation`` is a sum of lengths of differences, so up to a point it holds neighbours to one and the same turn:
it finds parts that are rigid, and takes from a cloth that swings nearly all differences of its turns. Where things bend
it is left out, and rigidity, which ties positions to these turns, falls to nothing by the end of an update.

The evidence is of positions alone, so it means the same with and without the terms. A patch, a hundredth of what moves,
has turned as its positions say; the evidence is by how much it turned otherwise than most patches around, less what of
its motion is no turn. Joints are few among the patches, and what is met badly moves unlike any rigid body: both say no.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scas4d_core.effects.effect import Effect, EffectGroup, refusal_at_zero
from scas4d_core.effects.evidence import Evidence, FrameObservation
from scas4d_core.update.parts import PlanBuilder

if TYPE_CHECKING:
    from scas4d_core.gaussians import Gaussians
    from scas4d_core.settings import Settings

SAMPLE = 4000
"""Gaussians that patches are made of, or up to twice as many: a patch is the same part of a thing in all states."""
PATCH = 40
"""Gaussians of a patch beside its middle: positions of fewer are too noisy to show a turn."""
PATCHES = 400
"""Or up to twice as many: the evidence is a median over them."""
AROUND = 19
"""Patches that a patch is compared with, the nearest: with it a twentieth of what moves."""
REST = 1e-3
"""Of the size of what moves: where nine tenths of it move less in a frame, the frame says nothing."""

# Thresholds, in radians: from 0.030 while `cloth` swings and the effect is off, backwards and with half of the cameras
# too, from 0.037 while it is on; in all other captures 0.004 at most while it is off, 0.014 with rotation pinned off.

Double = NDArray[np.float64]


def patch_rotations(before: Double, after: Double) -> tuple[Double, Double]:
    """The rotations that come nearest to the motions of patches (Kabsch), and what of these is no rotation.

    Args:
        before, after: [P, n, 3] metres, a patch's Gaussians.

    Returns:
        [P, 3, 3], and [P] root mean square distance to the rotated patch, relative to the patch's own size.
    """
    old, new = (points - points.mean(axis=1, keepdims=True) for points in (before, after))
    left, lengths, right = np.linalg.svd(np.swapaxes(new, 1, 2) @ old)
    sign = np.sign(np.linalg.det(left) * np.linalg.det(right))
    left[:, :, 2] *= sign[:, None]
    lengths[:, 2] *= sign
    size = np.maximum(np.square(old).sum(axis=(1, 2)), 1e-20)
    rest = size + np.square(new).sum(axis=(1, 2)) - 2 * lengths.sum(axis=1)
    return left @ right, np.sqrt(np.maximum(rest, 0) / size)


def measure_bending(before: Gaussians, after: Gaussians) -> float | None:
    """How much patches turn otherwise than those around them, median in radians; None: too little moves, or too few.

    Args:
        before, after: Θ_{t−1} and Θ_t, the same Gaussians.
    """
    rows = np.flatnonzero(before.moving)
    rows = rows[:: max(1, len(rows) // SAMPLE)]
    old, new = before.means[rows].astype(np.float64), after.means[rows].astype(np.float64)
    sound = np.isfinite(old).all(axis=1) & np.isfinite(new).all(axis=1)
    old, new = old[sound], new[sound]
    middles = old[:: max(1, len(old) // PATCHES)]
    if len(old) <= PATCH or len(middles) <= AROUND:
        return None
    ways = np.linalg.norm(new - old, axis=1)
    if np.quantile(ways, 0.9) < REST * np.linalg.norm(np.ptp(old, axis=0)):
        return None
    patches = cKDTree(old).query(middles, k=PATCH + 1)[1]
    turns, rest = patch_rotations(old[patches], new[patches])
    around = np.asarray(cKDTree(middles).query(middles, k=AROUND + 1)[1])[:, 1:]
    cosines = (np.einsum("pkij,pij->pk", turns[around], turns) - 1) / 2
    angles = np.median(np.arccos(np.clip(cosines, -1, 1)), axis=1)
    return float(np.median(angles - rest))


@dataclass(frozen=True)
class Bending(Effect):
    """Turns that are free of one another."""

    def refusal(self, settings: Settings) -> tuple[str, str] | None:
        """Refused where the term that it leaves out is pinned, or has no weight."""
        mode = settings.effects.get("rotation", "auto")
        if mode != "auto":
            return f"effects.rotation is '{mode}'", "leave rotation 'auto'"
        return refusal_at_zero(settings, "weights.rotation")

    def evidence(self, seen: FrameObservation) -> Evidence | None:
        """The turn of neighbourhoods against those around them, from a frame to the next."""
        angle = measure_bending(seen.before, seen.result.gaussians)
        if angle is None:
            return None
        angle = max(0.0, angle)
        return Evidence(min(1.0, angle), f"neighbourhoods turn {np.degrees(angle):.1f}° a frame unlike each other")

    def register(self, builder: PlanBuilder) -> None:
        """Leaves out the term of rotation, and lets rigidity fall along an update."""
        builder.plan.neighbour_terms, builder.plan.rotation = True, 0.0
        builder.plan.rigidity_fades = builder.plan.rigidity > 0


EFFECT = Bending(
    name="bending",
    group=EffectGroup.COHERENCE,
    description="Neighbours rotate each in their own way, as in cloth: the term rotation is left out.",
    disambiguation="Rotations of patches beyond the rest of their motion; joints between rigid parts are too few to "
    "count.",
    cost="1 % of an update: the rotations of 400 patches per frame",
    auto=True,
    on_above=0.018,
    off_below=0.012,
)
