"""Shading of moving Gaussians: as objects rotate, colours are updated from the images once per frame, in closed form.

With a learning rate low enough not to absorb motion, Adam cannot follow the shading of rotating objects. The error then
carries over to the next frame and grows. At the end of an update, the motion is known, so ``closed_form`` treats the
remaining residual as a change in appearance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scas4d_core.effects.appearance.closed_form import follow_pictures
from scas4d_core.effects.effect import Effect, EffectGroup
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians
from scas4d_core.update.parts import Attempt, PlanBuilder, UpdatePart


class ShadingPart(UpdatePart):
    """Updates the colours of moving Gaussians at the end of an update."""

    def __init__(self, builder: PlanBuilder) -> None:
        self._moves = np.zeros(len(builder.first), np.uint8)
        self._moves[builder.hierarchy.rows] = 1

    def end(self, attempt: Attempt, state: Gaussians) -> Gaussians:
        """Updates the colours unless the update fell back to Θ_{t−1} or keeps the colours of moving Gaussians."""
        if attempt.kept is Candidate.PREVIOUS or attempt.rates.colour == 0 or not self._moves.any():
            return state
        return follow_pictures(state, attempt.views, attempt.renderer, self._moves)


@dataclass(frozen=True)
class Shading(Effect):
    """Updates the colours of moving Gaussians in closed form."""

    def register(self, builder: PlanBuilder) -> None:
        """Adds a ``ShadingPart`` to the updates."""
        builder.parts.append(ShadingPart(builder))


EFFECT = Shading(
    name="shading",
    group=EffectGroup.APPEARANCE,
    description="The colours of moving Gaussians follow the images once per frame, as objects rotate in the light.",
    disambiguation="Changes only moving Gaussians, once the motion of the frame is known and camera gains are removed.",
    cost="one rendering of each view per frame, with its blending weights",
    positive_setting="rate_colour",
)
