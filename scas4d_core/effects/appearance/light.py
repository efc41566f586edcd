"""Changing light: colours adapt faster, and moving Gaussians adapt at least as fast as static ones.

If a light moves or dims, the colours change with few degrees of freedom: surfaces with similar orientation and position
become brighter or darker together. This joint change is the evidence. The colours themselves adapt individually.
Learning an additional relative change, linear or quadratic in orientation and position, did not improve the renderings.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scas4d_core.effects.effect import Effect, EffectGroup
from scas4d_core.effects.evidence import Evidence, FrameObservation
from scas4d_core.update.parts import PlanBuilder

if TYPE_CHECKING:
    from scas4d_core.gaussians import Gaussians

# The thresholds are based on these measured changes per frame: at most 0.032 on the five objects (on robot, which turns
# fastest and whose shading therefore changes under constant light), 0.012 on stage with its moving shadows, 0.023 to
# 0.061 on lamps while the light moves.
SAMPLE = 2000
"""Approximate number of Gaussians used for the evidence, which is sufficient for 7 unknowns per channel. The actual
number may be up to twice as large."""
OPAQUE = 0.3
"""Minimum opacity at which a Gaussian's colour counts as the colour of a surface."""


Double = NDArray[np.float64]


def orientation_and_place(state: Gaussians, rows: NDArray[np.int64], centre: Double) -> Double:
    """Returns the [R, 7] regressors of the relative lighting change: 1, the normal, and the position.

    The normal is the shortest axis, oriented towards the cameras. The position is in metres, relative to the mean
    position.

    Args:
        state: state that contains the Gaussians.
        rows: [R] rows of the Gaussians.
        centre: [3] centre of the cameras, in metres.
    """
    from scas4d_core.kernels.turns import shortest_axes  # deferred import, because it loads the kernels

    means, normals = state.means[rows].astype(np.float64), np.empty((len(rows), 3))
    shortest_axes(state.factors[rows], normals)
    normals *= np.where((normals * (centre - means)).sum(axis=1) < 0, -1, 1)[:, None]
    return np.concatenate([np.ones((len(rows), 1)), normals, means - means.mean(axis=0)], axis=1)


def change_of_light(before: Gaussians, after: Gaussians, centre: Double) -> float:
    """Returns the RMS relative colour change between two states that orientation and position explain.

    Args:
        before, after: Θ_{t−1} and Θ_t, with the same Gaussians.
        centre: [3] centre of the cameras, in metres.
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
        # with seven unknowns, the normal equations are accurate enough
        light = np.linalg.lstsq(weighed.T @ weighed, weighed.T @ change, rcond=None)[0]
        explained += float(np.square(weighed @ light).sum())
        total += float(np.square(old).sum())
    return float(np.sqrt(explained / max(total, 1e-12)))


@dataclass(frozen=True)
class Light(Effect):
    """Adapts colours faster while the lighting changes."""

    def evidence(self, seen: FrameObservation) -> Evidence | None:
        """Returns how much the colours change together from one frame to the next."""
        if not seen.views:
            return None
        centre = np.mean([camera.centre for camera in seen.rig.cameras], axis=0)
        change = change_of_light(seen.before, seen.result.gaussians, centre)
        return Evidence(min(1.0, change), f"the lighting changes by {change:.1%} per frame")

    def register(self, builder: PlanBuilder) -> None:
        """Enables faster colour adaptation, and disables skipping of frames that the previous state already fits."""
        builder.plan.learns_colours().changing_light = True
        builder.plan.disables_skip = True


EFFECT = Light(
    name="light",
    group=EffectGroup.APPEARANCE,
    description="While the lighting changes, all colours adapt faster; those of moving Gaussians adapt as fast as "
    "those of static ones.",
    disambiguation="Colours include the lighting of their frame; gains account for flicker and differences between "
    "cameras.",
    cost="no measurable cost",
    auto=True,
    on_above=0.035,
    off_below=0.02,
    positive_setting="rate_colour",
)
