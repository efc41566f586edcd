"""Bending: in objects that bend everywhere, such as cloth, neighbours rotate independently.

The loss term ``rotation`` is a sum of norms of differences, so it removes rotation differences below a threshold. This
helps to find rigid parts, but in swinging cloth nearly all rotation differences are removed. In bending scenes, the
term is therefore switched off. Rigidity, which couples positions to these rotations, fades to zero during an update.

The evidence uses only positions, so it is comparable with and without these terms. It measures patches that each
contain about a hundredth of the moving Gaussians. The evidence is the median rotation of a patch relative to the
surrounding patches, minus the part of its motion that is not a rotation. Joints affect few patches, and badly tracked
patches do not move rigidly, so neither provides evidence.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scas4d_core.effects.effect import Effect, EffectGroup
from scas4d_core.effects.evidence import Evidence, FrameObservation
from scas4d_core.update.parts import PlanBuilder

if TYPE_CHECKING:
    from scas4d_core.gaussians import Gaussians
    from scas4d_core.settings import Settings

SAMPLE = 4000
"""Approximate number of sampled Gaussians, which makes the extent of patches similar in all states. The actual number
may be up to twice as large."""
PATCH = 40
"""Number of Gaussians in a patch in addition to its centre; with fewer, the rotation is too noisy."""
PATCHES = 400
"""Approximate number of patches over which the median is computed. The actual number may be up to twice as large."""
AROUND = 19
"""Number of nearest patches that each patch is compared with; together they cover a twentieth of the object."""
REST = 1e-3
"""Motion relative to the extent of the moving Gaussians. If 90% of them move less, a frame provides no evidence."""

# The thresholds are based on these measurements, in radians: on swinging `cloth`, at least 0.030 while the effect is
# off (also when played backwards or with half of the cameras), and at least 0.037 while it is on. All other captures
# have at most 0.004 while it is off, and 0.014 with rotation pinned off.

Double = NDArray[np.float64]


def patch_rotations(before: Double, after: Double) -> tuple[Double, Double]:
    """Returns the rotation that best fits the motion of each patch (Kabsch), and the residual motion.

    Args:
        before, after: [P, n, 3] positions of each patch's Gaussians, in metres.

    Returns:
        [P, 3, 3] rotations, and the [P] RMS distance to the rotated patch relative to the patch size.
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
    """Returns the median rotation of patches relative to surrounding patches, in radians, or None if too little moves.

    Args:
        before, after: Θ_{t−1} and Θ_t, with the same Gaussians.
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
    """Lets neighbours rotate independently."""

    def refusal(self, settings: Settings) -> tuple[str, str] | None:
        """Returns a refusal if the rotation term, which this effect removes, is pinned or has weight 0."""
        mode = settings.effects.get("rotation", "auto")
        if mode != "auto":
            return f"effects.rotation is '{mode}'", "set effects.rotation to 'auto'"
        return super().refusal(settings)

    def evidence(self, seen: FrameObservation) -> Evidence | None:
        """Returns the relative rotation between neighbourhoods from one frame to the next."""
        angle = measure_bending(seen.before, seen.result.gaussians)
        if angle is None:
            return None
        angle = max(0.0, angle)
        return Evidence(min(1.0, angle), f"patches rotate {np.degrees(angle):.1f}° per frame relative to each other")

    def register(self, builder: PlanBuilder) -> None:
        """Removes the rotation term, and lets rigidity fade during an update."""
        builder.plan.neighbour_terms, builder.plan.rotation = True, 0.0
        builder.plan.rigidity_fades = builder.plan.rigidity > 0


EFFECT = Bending(
    name="bending",
    group=EffectGroup.COHERENCE,
    description="Neighbours rotate independently, as in cloth: the rotation term is off, and rigidity fades to 0.",
    disambiguation="Only patch rotations that exceed the rest of the patch's motion count; joints between rigid parts "
    "affect too few patches.",
    cost="1% of an update: the rotations of 400 patches per frame",
    auto=True,
    on_above=0.018,
    off_below=0.012,
    positive_setting="weights.rotation",
)
