"""Shading of what moves: as things turn in the light, their colours follow the pictures, once a frame in closed form.

A hundred steps of Adam at a rate that leaves motion visible do not follow what turns: the error is carried into the
next frame, and grows. At the end of an update the motion is found, and the rest is looks (``closed_form``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from scas4d_core.effects.appearance.closed_form import follow_pictures
from scas4d_core.effects.effect import Effect, EffectGroup, refusal_at_zero
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians
from scas4d_core.update.parts import Attempt, PlanBuilder, UpdatePart

if TYPE_CHECKING:
    from scas4d_core.settings import Settings


class ShadingPart(UpdatePart):
    """Steps the colours of what moves at the end of an update."""

    def __init__(self, builder: PlanBuilder) -> None:
        self._moves = np.zeros(len(builder.first), np.uint8)
        self._moves[builder.hierarchy.rows] = 1

    def end(self, attempt: Attempt, state: Gaussians) -> Gaussians:
        """Steps them, where a motion is what is kept and colours were not held."""
        if attempt.kept is Candidate.PREVIOUS or attempt.rates.colour == 0 or not self._moves.any():
            return state
        return follow_pictures(state, attempt.views, attempt.renderer, self._moves)


@dataclass(frozen=True)
class Shading(Effect):
    """A closed-form step of the colours of what moves."""

    def refusal(self, settings: Settings) -> tuple[str, str] | None:
        """Refused with a rate of 0."""
        return refusal_at_zero(settings, "rate_colour")

    def register(self, builder: PlanBuilder) -> None:
        """Adds the part."""
        builder.parts.append(ShadingPart(builder))


EFFECT = Shading(
    name="shading",
    group=EffectGroup.APPEARANCE,
    description="The colours of moving Gaussians follow the pictures once per frame, as objects rotate in the light.",
    disambiguation="Moving Gaussians only, once the motion of the frame is found; camera gains are removed before.",
    cost="one render of each view, with its blending weights, per frame",
)
