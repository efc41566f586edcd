"""Colour that depends on direction: things mirror their surroundings, which stay while the things turn.

Each Gaussian has a normal and a strength, all share one environment (``kernels.appearance.direction``). A colour by the
Gaussian's own harmonics, turned with it, would be wrong after a few frames: the highlight of a lamp that stands wanders
over what turns. It is learnt with frame 0 (``first_frame.glossy``) and goes on in the updates: what turns brings its
highlights to other places, which tells normals and lamps better than one frame can.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scas4d_core.effects.effect import Effect, Group, refused_on_gpu
from scas4d_core.effects.evidence import Evidence
from scas4d_core.effects.parts import Array, Part, PartsBuilder, Work
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians

if TYPE_CHECKING:
    from scas4d_core.effects.evidence import Seen
    from scas4d_core.rasterize.cpu import Gradients
    from scas4d_core.rasterize.shading import Shading
    from scas4d_core.settings import Settings
    from scas4d_core.update.picture_loss import PictureLoss
    from scas4d_core.update.training_view import TrainingView

RATE_GLOSS, RATE_ENVIRONMENT, RATE_NEARNESS = 2e-3, 1e-2, 1e-3
"""Adam rates in an update, falling to a tenth; of the gloss see ``shading.gloss_rate``."""
SMOOTH_EVERY = 10
"""Iterations between two averages of the changes over neighbours."""
FEW = 4
"""Views that the evidence is taken from."""


class DirectionPart(Part):
    """Gloss and environment as parameters of an update; does nothing in a scene whose frame 0 had neither."""

    def __init__(self, builder: PartsBuilder) -> None:
        self._rows, self._roots = builder.hierarchy.rows, builder.first.means
        self._shading: Shading | None = None
        self._turns: Array
        self._near: NDArray[np.int64] | None = None

    def start(self, work: Work) -> None:
        """Takes both from Θ_{t−1}; the gloss is kept as it was turned there."""
        from scas4d_core.rasterize.shading import Shading, gloss_rate, neighbourhoods, without_turn

        state = work.previous
        self._shading = None
        if state.gloss is None or state.environment is None:
            return
        rates = (gloss_rate(RATE_GLOSS, state.gloss), RATE_ENVIRONMENT, RATE_NEARNESS)
        self._shading = Shading(state.gloss.copy(), state.environment.copy(), rates)
        work.gloss, work.environment = self._shading.gloss, self._shading.environment
        if self._near is None:
            self._near = neighbourhoods(self._roots[: len(state.gloss)])
        self._turns = without_turn(len(state))

    def show(self, work: Work, view: TrainingView) -> None:
        """The colours as the view's camera sees them."""
        if self._shading is not None:
            self._turns[self._rows] = work.deformation.turns
            self._shading.show(work.deformation.means, self._turns, work.colours, view.camera, work.features)

    def saw(self, work: Work, view: TrainingView, picture: PictureLoss, gradients: Gradients) -> None:
        """Turns the gradients of features into those of colours, gloss and environment."""
        if self._shading is not None:
            self._shading.saw(work.deformation.means, self._turns, work.colours, view.camera, gradients.features)

    def step(self, work: Work, iteration: int, planned: int) -> None:
        """Steps both; changes of the gloss are averaged over neighbours from time to time."""
        if self._shading is not None:
            self._shading.step(1 - 0.9 * iteration / planned)
            if (iteration + 1) % SMOOTH_EVERY == 0:
                self._shading.smooth(self._roots)

    def end(self, work: Work, state: Gaussians) -> Gaussians:
        """Θ_t has those of the end, where that is what is kept; the gloss is turned with its neighbourhood."""
        if self._shading is None or self._near is None or work.kept is Candidate.STILL:
            return state
        from scas4d_core.rasterize.shading import neighbourhood_turns

        learnt = work.kept is Candidate.END
        gloss = self._shading.gloss if learnt else work.previous.gloss
        assert gloss is not None
        turns = neighbourhood_turns(work.previous.means, state.means, self._near)
        return state.replace(
            gloss=np.einsum("nij,nj->ni", turns, gloss).astype(np.float32),
            environment=self._shading.environment if learnt else work.previous.environment,
        )


@dataclass(frozen=True)
class Direction(Effect):
    """Waits for the evidence of frame 0."""

    def refused(self, settings: Settings) -> tuple[str, str] | None:
        """Refused on a GPU, whose update does not know it."""
        return refused_on_gpu(settings)

    def evidence(self, seen: Seen) -> Evidence | None:
        """The share of the squared error of a few pictures that the gloss takes away."""
        from scas4d_core.rasterize.shading import features_seen
        from scas4d_core.update.best_state import spread

        if seen.before.gloss is None:
            return None
        state = seen.result.gaussians
        chosen = set(spread(seen.rig, [view.name for view in seen.views], FEW))
        left = np.zeros(2)
        for view in seen.views:
            if view.name not in chosen:
                continue
            for which, features in enumerate((state.features(state.colours), features_seen(state, view.camera))):
                seen.picture.measure(state.means, state.factors, state.opacities, features, view)
                left[which] += 10 ** (-seen.picture.psnr / 10)
        share = float(max(0, 1 - left[1] / max(left[0], 1e-12)))
        return Evidence(share, f"explains {100 * share:.0f} % of the residual")

    def join(self, builder: PartsBuilder) -> None:
        """Adds the part; what a camera sees of what stands is another thing in each frame."""
        builder.whole = True
        builder.parts.append(DirectionPart(builder))


EFFECT = Direction(
    name="direction",
    group=Group.APPEARANCE,
    says="Colour by direction: glossy things mirror lamps and surroundings, which stay while the things turn.",
    gauge="The environment sums to nothing over the sphere: what is seen from everywhere is colour.",
    cost="two passes over the Gaussians a rendered view; a trial in frame 0, which takes half as long again where on",
    auto=True,
    on_above=0.1,  # the trial has 0.25 on `gloss`, at most 0.03 on the five objects
)
