"""Moving shadows and light: colours of static Gaussians are updated from the images once per frame, in closed form.

At the end of an update, the colours of static Gaussians are updated as in ``closed_form``, but only in frames in which
the static scene looks different from frame 0. In other frames, this step would fit noise and disagreement between
cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from scas4d_core.effects.appearance.closed_form import follow_pictures
from scas4d_core.effects.effect import Effect, EffectGroup
from scas4d_core.effects.evidence import Evidence
from scas4d_core.engines.renderer import BLOCK
from scas4d_core.engines.views import SIDE
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians
from scas4d_core.update.parts import Array, Arrays, Attempt, PlanBuilder, UpdatePart

if TYPE_CHECKING:
    from scas4d_core.effects.evidence import FrameObservation
    from scas4d_core.engines.renderer import Renderer
    from scas4d_core.engines.views import CameraArrays, TrainingView

Mask = NDArray[np.bool_]

NAME = "shadows"
CHANGED = 0.02
"""Difference of a mean colour, RGB in [0, 1], above which a block of pixels looks different from frame 0."""
HARDLY = 0.005
"""Maximum share of changed static blocks at which nothing is learnt from a frame. With a tenth of this value,
`basketball` gains 0.06 dB on changed pixels, but noise is more likely to be learnt."""
ENOUGH = 0.5
"""Minimum share of frame 0's cameras that a frame must contain for an update; with fewer, noise would be learnt."""
MIN_STATIC = 0.05
"""Minimum share of static Gaussians; with fewer, there is no background to receive shadows."""


_reached_masks: WeakKeyDictionary[Gaussians, dict[str, tuple[CameraArrays, Mask]]] = WeakKeyDictionary()
"""For each state, the camera and mask of each view, keyed by camera name. The update and the evidence share them."""


class ShadowsPart(UpdatePart):
    """Updates the colours of static Gaussians at the end of an update."""

    def __init__(self, builder: PlanBuilder) -> None:
        self._static = np.ones(len(builder.first), np.uint8)
        self._static[builder.hierarchy.rows] = 0

    def end(self, attempt: Attempt, state: Gaussians) -> Gaussians:
        """Updates the colours if the final state of the update is kept and the frame looks different from frame 0."""
        if attempt.kept is not Candidate.END or not self._static.any() or attempt.rates.static_colour == 0:
            return state
        before: Arrays = attempt.carried.get(NAME, {})
        known = [view for view in attempt.views if view.name in before]
        if len(known) < ENOUGH * len(before):
            return state
        compared = _compared(before, known, state, attempt.renderer)
        if sum((squares & static).sum() for squares, static in compared) <= HARDLY * sum(s.sum() for _, s in compared):
            return state
        followed = follow_pictures(state, known, attempt.renderer, self._static)
        _reached_masks[followed] = _reached_masks[state]  # only colours have changed
        return followed


@dataclass(frozen=True)
class Shadows(Effect):
    """Updates the colours of static Gaussians in closed form."""

    def first_frame_arrays(self, seen: FrameObservation) -> Arrays | None:
        """Returns a [h, w, 4] float16 array per view, or None if only a few Gaussians are static.

        An array contains the mean colour of each block of pixels, followed by 1 if moving Gaussians reach the block.
        """
        state = seen.result.gaussians
        share = float((~state.moving).mean())
        if 0 < share < MIN_STATIC:
            return None
        means = [_means(view) for view in seen.views]
        # If all Gaussians appear to move, as without masks, the static ones are not known yet.
        hidden = _hidden(seen.views, state, seen.renderer) if share else [np.zeros(each.shape[:2]) for each in means]
        return {
            view.name: np.concatenate([mean, reached[..., None]], axis=-1).astype(np.float16)
            for view, mean, reached in zip(seen.views, means, hidden, strict=True)
        }

    def on_at_first(self, seen: FrameObservation) -> bool:
        """Returns whether enough of the scene is static."""
        return bool((~seen.result.gaussians.moving).mean() >= MIN_STATIC)

    def evidence(self, seen: FrameObservation) -> Evidence | None:
        """Returns the share of changed blocks among all blocks that are static in frame 0 and in this frame."""
        before: Arrays = seen.result.carried.get(NAME, {})
        if seen.result.gaussians.moving.all():
            return None
        if not before:
            return Evidence(0.0, "")  # the arrays of frame 0 were lost
        known = [view for view in seen.views if view.name in before]
        masks = _compared(before, known, seen.result.gaussians, seen.renderer)
        changed = sum(int((squares & static).sum()) for squares, static in masks)
        compared = sum(int(static.sum()) for _, static in masks)
        if compared == 0:
            return None
        share = changed / compared
        return Evidence(share, f"{100 * share:.0f}% of the static scene looks different from frame 0")

    def register(self, builder: PlanBuilder) -> None:
        """Adds a ``ShadowsPart`` to the updates."""
        builder.parts.append(ShadowsPart(builder))


def _means(view: TrainingView) -> Array:
    """Returns the [h, w, 3] mean colours of the complete blocks of an image, with the camera's exposure removed."""
    gain, offset = view.exposure[:3, 0], view.exposure[:3, 1]
    return (view.squares - offset) / gain


def _compared(
    before: Arrays, views: Sequence[TrainingView], state: Gaussians, renderer: Renderer
) -> list[tuple[Mask, Mask]]:
    """Compares views with frame 0.

    Returns:
        For each view, [h, w] masks of changed blocks, and of blocks without moving Gaussians in frame 0 and now.
    """
    compared = []
    for view, hidden in zip(views, _hidden(views, state, renderer), strict=True):
        first = before[view.name]
        changed = np.abs(_means(view) - first[..., :3].astype(np.float32)).max(axis=-1) >= CHANGED
        compared.append((changed, (first[..., 3] == 0) & ~hidden))
    return compared


def _hidden(views: Sequence[TrainingView], state: Gaussians, renderer: Renderer) -> list[Mask]:
    """Returns the [h, w] mask of each view's blocks that moving Gaussians reach."""
    cached, each = _reached_masks.setdefault(state, {}), SIDE // BLOCK  # blocks per side of a square
    missing = [view for view in views if view.name not in cached or cached[view.name][0] is not view.camera]
    for view, blocks in zip(missing, renderer.reached(state, [view.camera for view in missing]), strict=True):
        height, width = view.target.shape[1] // SIDE, view.target.shape[2] // SIDE
        grid = blocks[: height * each, : width * each].reshape(height, each, width, each)
        cached[view.name] = view.camera, np.asarray(grid.any(axis=(1, 3)))
    return [cached[view.name][1] for view in views]


EFFECT = Shadows(
    name=NAME,
    group=EffectGroup.APPEARANCE,
    description="The colours of static Gaussians follow the images once per frame, as shadows and light move over "
    "them.",
    disambiguation="Changes only static Gaussians, in frames that look different from frame 0 after camera gains are "
    "removed.",
    cost="one rendering of each view per frame, with its blending weights",
    auto=True,
    on_above=0.02,
    off_below=0.005,
    positive_setting="rate_static_colour",
)
