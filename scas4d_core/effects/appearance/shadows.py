"""Shadows and light that wander over what stands: its colours follow the pictures once a frame, in closed form.

At the end of an update the standing Gaussians' colours take the steps of ``closed_form``. That is done in frames in
which what stands looks other than in frame 0: elsewhere it would fit noise, and what cameras do not agree upon.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.effects.appearance.closed_form import follow_pictures
from scas4d_core.effects.effect import Effect, EffectGroup, refusal_at_zero
from scas4d_core.effects.evidence import Evidence
from scas4d_core.engines.renderer import BLOCK
from scas4d_core.engines.views import SIDE
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians
from scas4d_core.update.parts import Array, Arrays, Attempt, PlanBuilder, UpdatePart

if TYPE_CHECKING:
    from scas4d_core.effects.evidence import FrameObservation
    from scas4d_core.engines.renderer import Renderer
    from scas4d_core.engines.views import TrainingView
    from scas4d_core.settings import Settings

NAME = "shadows"
CHANGED = 0.02
"""Difference of a mean colour, RGB in 0…1, from which a square looks other than in frame 0."""
HARDLY = 0.005
"""Share of the squares of what stands up to which nothing is learnt from a frame. With a tenth of it `basketball`
gains 0.06 dB on changed pixels, and noise is nearer to being learnt."""
ENOUGH = 0.5
"""Share of the cameras of frame 0 from which a frame teaches: what a few of them see is their own noise as well."""
STANDS = 0.05
"""Share of Gaussians that stand, below which there is nothing for shadows to wander over."""


class ShadowsPart(UpdatePart):
    """Steps the colours of what stands at the end of an update."""

    def __init__(self, builder: PlanBuilder) -> None:
        self._stands = np.ones(len(builder.first), np.uint8)
        self._stands[builder.hierarchy.rows] = 0

    def end(self, attempt: Attempt, state: Gaussians) -> Gaussians:
        """Steps them, where the end of the update is what is kept."""
        if attempt.kept is not Candidate.END or not self._stands.any() or attempt.rates.static_colour == 0:
            return state
        before: Arrays = attempt.carried.get(NAME, {})
        known = [view for view in attempt.views if view.name in before]
        if len(known) < ENOUGH * len(before):
            return state
        compared = [_compared(before[view.name], view, state, attempt.renderer) for view in known]
        if sum((squares & stands).sum() for squares, stands in compared) <= HARDLY * sum(s.sum() for _, s in compared):
            return state
        return follow_pictures(state, known, attempt.renderer, self._stands)


@dataclass(frozen=True)
class Shadows(Effect):
    """A closed-form step of the colours of what stands."""

    def refusal(self, settings: Settings) -> tuple[str, str] | None:
        """Refused with a rate of 0."""
        return refusal_at_zero(settings, "rate_static_colour")

    def first_frame_arrays(self, seen: FrameObservation) -> Arrays | None:
        """[h, w, 4] float16 of each view: mean colours of squares, and 1 where what moves reaches."""
        state = seen.result.gaussians
        stands = float((~state.moving).mean())
        if 0 < stands < STANDS:
            return None
        arrays = {}
        for view in seen.views:
            means = _means(view)
            # Where all seems to move, as without masks, it is not known yet what stands.
            hidden = _hidden(view, state, seen.renderer) if stands else np.zeros(means.shape[:2])
            arrays[view.name] = np.concatenate([means, hidden[..., None]], axis=-1).astype(np.float16)
        return arrays

    def on_at_first(self, seen: FrameObservation) -> bool:
        """True where something stands."""
        return bool((~seen.result.gaussians.moving).mean() >= STANDS)

    def evidence(self, seen: FrameObservation) -> Evidence | None:
        """Share of what stands, seen in frame 0 and now, that looks other than then."""
        before: Arrays = seen.result.carried.get(NAME, {})
        if seen.result.gaussians.moving.all():
            return None
        changed = compared = 0
        for view in seen.views:
            if view.name in before:
                squares, stands = _compared(before[view.name], view, seen.result.gaussians, seen.renderer)
                changed += int((squares & stands).sum())
                compared += int(stands.sum())
        if not before:
            return Evidence(0.0, "")  # what frame 0 left is lost
        if compared == 0:
            return None
        share = changed / compared
        return Evidence(share, f"{100 * share:.0f} % of what stands looks other than in frame 0")

    def register(self, builder: PlanBuilder) -> None:
        """Adds the part."""
        builder.parts.append(ShadowsPart(builder))


def _means(view: TrainingView) -> Array:
    """[h, w, 3] mean colours of the picture's whole squares, without the camera's exposure."""
    gain, offset = view.exposure[:3, 0], view.exposure[:3, 1]
    return (view.squares - offset) / gain


def _compared(
    before: NDArray[Any], view: TrainingView, state: Gaussians, renderer: Renderer
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """[h, w] squares that look other than before, and those that what moves reaches neither then nor now."""
    changed: NDArray[np.bool_] = np.abs(_means(view) - before[..., :3].astype(np.float32)).max(axis=-1) >= CHANGED
    return changed, (before[..., 3] == 0) & ~_hidden(view, state, renderer)


def _hidden(view: TrainingView, state: Gaussians, renderer: Renderer) -> NDArray[np.bool_]:
    """[h, w] squares that what moves reaches."""
    height, width, each = view.target.shape[1] // SIDE, view.target.shape[2] // SIDE, SIDE // BLOCK
    blocks = renderer.reached(state, np.flatnonzero(state.moving), view.camera)
    grid = blocks[: height * each, : width * each]
    return np.asarray(grid.reshape(height, each, width, each).any(axis=(1, 3)))


EFFECT = Shadows(
    name=NAME,
    group=EffectGroup.APPEARANCE,
    description="The colours of static Gaussians follow the pictures once per frame, as shadows and light move over "
    "them.",
    disambiguation="Static Gaussians only, where they look different from frame 0; camera gains are removed before.",
    cost="one render of each view, with its blending weights, per frame",
    auto=True,
    on_above=0.02,
    off_below=0.005,
)
