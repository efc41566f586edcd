"""Colour that depends on direction: things mirror their surroundings, which stay while the things turn.

Each Gaussian has a normal and a strength, all share one environment (``kernels.appearance.direction``). A colour by the
Gaussian's own harmonics, turned with it, would be wrong after a few frames: the highlight of a lamp that stands wanders
over what turns. It is learnt with frame 0 (``first_frame.glossy``) and goes on in the updates: what turns brings its
highlights to other places, which determines normals and lamps better than one frame can.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scas4d_core.effects.effect import Effect, EffectGroup
from scas4d_core.effects.evidence import Evidence
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians
from scas4d_core.update.parts import Array, Attempt, PlanBuilder, UpdatePart

if TYPE_CHECKING:
    from scas4d_core.effects.evidence import FrameObservation

TURNED_TOGETHER = 32
"""Gaussians from whose places the rotation of a normal is estimated."""
FEW = 4
"""Views that the evidence is taken from."""


def neighbourhood_turns(before: Array, after: Array, near: NDArray[np.int64]) -> NDArray[np.float64]:
    """[M, 3, 3] the rotation of each Gaussian's neighbourhood between two states (Kabsch 1976).

    Normals are turned by it rather than by the rotations of single Gaussians: a normal belongs to a surface, and places
    do not add up the errors of all frames before. On `gloss` both came out alike.

    Args:
        before, after: [N, 3] metres. near: [M, k] rows of the neighbourhood.
    """
    there, now = before[near].astype(np.float64), after[near].astype(np.float64)
    there -= there.mean(axis=1, keepdims=True)
    now -= now.mean(axis=1, keepdims=True)
    spread = np.einsum("nki,nkj->nij", now, there)
    spread[~np.isfinite(spread).all(axis=(1, 2))] = np.eye(3)  # such a place is held back; its neighbours keep theirs
    left, _, right = np.linalg.svd(spread)
    left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
    turns: NDArray[np.float64] = left @ right
    return turns


def neighbourhoods(means: Array) -> NDArray[np.int64]:
    """[N, k] the nearest of each, itself the first."""
    count = len(means)
    nearest: NDArray[np.int64] = np.asarray(cKDTree(means).query(means, min(TURNED_TOGETHER, count))[1])
    return nearest.reshape(count, -1)


class DirectionPart(UpdatePart):
    """Turns the gloss with the deformation; does nothing in a scene whose frame 0 had none."""

    def __init__(self, builder: PlanBuilder) -> None:
        self._roots = builder.first.means
        self._near: NDArray[np.int64] | None = None

    def end(self, attempt: Attempt, state: Gaussians) -> Gaussians:
        """Θ_t has the gloss turned with its neighbourhood, where it moved."""
        if state.gloss is None or state.environment is None or attempt.kept is Candidate.PREVIOUS:
            return state
        if self._near is None:
            self._near = neighbourhoods(self._roots[: len(state.gloss)])
        turns = neighbourhood_turns(attempt.previous.means, state.means, self._near)
        return state.replace(gloss=np.einsum("nij,nj->ni", turns, state.gloss).astype(np.float32))


@dataclass(frozen=True)
class Direction(Effect):
    """Waits for the evidence of frame 0."""

    def evidence(self, seen: FrameObservation) -> Evidence | None:
        """The share of the squared error of a few pictures that the gloss takes away."""
        from scas4d_core.update.best_state import spread_cameras

        if seen.before.gloss is None:
            return None
        state = seen.result.gaussians
        chosen = set(spread_cameras(seen.rig, [view.name for view in seen.views], FEW))
        left = np.zeros(2)
        for view in seen.views:
            if view.name not in chosen:
                continue
            for which, features in enumerate((state.features(state.colours), None)):
                left[which] += 10 ** (-seen.renderer.compare(state, view, features).psnr / 10)
        share = float(max(0, 1 - left[1] / max(left[0], 1e-12)))
        return Evidence(share, f"explains {100 * share:.0f} % of the residual")

    def register(self, builder: PlanBuilder) -> None:
        """Adds the part; what a camera sees of what stands is another thing in each frame."""
        builder.plan.full_images = builder.plan.gloss = True
        builder.parts.append(DirectionPart(builder))


EFFECT = Direction(
    name="direction",
    group=EffectGroup.APPEARANCE,
    description="Colour depends on direction: glossy objects mirror lights and surroundings, which stay as the "
    "objects move.",
    disambiguation="The environment sums to zero over the sphere: what is seen from everywhere is colour.",
    cost="two passes over the Gaussians per rendered view; a trial in frame 0, which takes half as long again where on",
    auto=True,
    on_above=0.1,  # the trial has 0.25 on `gloss`, at most 0.03 on the five objects
)
