"""Light over time: while it changes, colours follow faster, those of what moves as fast as those of what stands.

What a lamp that crosses a room or dims does to colours is a few numbers: surfaces that face alike and lie together
become brighter or darker together. That is the evidence. The colours themselves take it on one by one: a relative
change linear or quadratic in orientation and place, learnt beside them, made pictures no better once they were free to.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scas4d_core.effects.effect import Effect, EffectGroup, refusal_at_zero
from scas4d_core.effects.evidence import Evidence, FrameObservation
from scas4d_core.update.parts import PlanBuilder

if TYPE_CHECKING:
    from scas4d_core.gaussians import Gaussians
    from scas4d_core.settings import Settings

# Thresholds of the effect: 0.032 a frame at most on the five objects (robot, as it turns fastest: shading follows what
# turns in a light that stays), 0.012 on stage, whose shadows wander, 0.023 to 0.061 while the lamp of lamps crosses.
SAMPLE = 2000
"""Gaussians at most that the evidence is taken from: it has seven numbers to find."""
OPAQUE = 0.3
"""Opacity from which a Gaussian's colour is that of a surface."""


Double = NDArray[np.float64]


def orientation_and_place(state: Gaussians, rows: NDArray[np.int64], centre: Double) -> Double:
    """[R, 7] 1, the normal, the place: what the relative change of a Gaussian's light is taken to be linear in.

    The normal is the shortest axis, on the side of the cameras. The place is in metres from the mean of all.

    Args:
        rows: [R] of the Gaussians that are asked for. centre: of the cameras, metres.
    """
    factors, means = state.factors[rows].astype(np.float64), state.means[rows].astype(np.float64)
    axes = np.linalg.eigh(factors @ factors.transpose(0, 2, 1)).eigenvectors
    normals = axes[:, :, 0]
    normals *= np.where((normals * (centre - means)).sum(axis=1) < 0, -1, 1)[:, None]
    return np.concatenate([np.ones((len(rows), 1)), normals, means - means.mean(axis=0)], axis=1)


def change_of_light(before: Gaussians, after: Gaussians, centre: Double) -> float:
    """Relative change of the colours from a state to the next that orientation and place explain, root mean square.

    Args:
        centre: [3] of the cameras, metres.
    """
    rows = np.flatnonzero(before.opacities > OPAQUE)
    rows = rows[:: max(1, len(rows) // SAMPLE)]
    if len(rows) == 0:
        return 0.0
    terms = orientation_and_place(after, rows, centre)
    explained = total = 0.0
    for channel in range(3):
        old = before.colours[rows, channel].astype(np.float64)
        change = after.colours[rows, channel] - old
        weighed = terms * old[:, None]
        light = np.linalg.lstsq(weighed.T @ weighed, weighed.T @ change, rcond=None)[0]  # seven numbers: well enough
        explained += float(np.square(weighed @ light).sum())
        total += float(np.square(old).sum())
    return float(np.sqrt(explained / max(total, 1e-12)))


@dataclass(frozen=True)
class Light(Effect):
    """Faster colours."""

    def refusal(self, settings: Settings) -> tuple[str, str] | None:
        """Refused where no colours of what moves are learnt."""
        return refusal_at_zero(settings, "rate_colour")

    def evidence(self, seen: FrameObservation) -> Evidence | None:
        """How much the colours change together from a frame to the next."""
        if not seen.views:
            return None
        centre = np.mean([camera.centre for camera in seen.rig.cameras], axis=0)
        change = change_of_light(seen.before, seen.result.gaussians, centre)
        return Evidence(min(1.0, change), f"the light changes by {change:.1%} a frame")

    def register(self, builder: PlanBuilder) -> None:
        """Frees the colours that are learnt, also from a frame that is shown well enough in the light before."""
        builder.plan.learns_colours().changing_light = True
        builder.plan.disables_skip = True


EFFECT = Light(
    name="light",
    group=EffectGroup.APPEARANCE,
    description="While the light changes, colours follow faster, those of moving Gaussians as fast as those of "
    "static ones.",
    disambiguation="Colours hold the light of their frame; differences between cameras, and flicker, are gains.",
    cost="none that can be measured",
    auto=True,
    on_above=0.035,
    off_below=0.02,
)
