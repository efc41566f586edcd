"""View-dependent colour: glossy objects reflect their surroundings, which stay fixed while the objects rotate.

Each Gaussian has a normal and a strength, and all share one environment (``kernels.appearance.direction``). Spherical
harmonics that rotate with each Gaussian would be wrong after a few frames, because the highlight of a fixed light moves
across a rotating surface. The gloss is learnt with frame 0 (``first_frame.glossy``) and refined by updates. As an
object rotates, highlights move across its surface, which constrains normals and lights better than a single frame does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from scas4d_core.effects.effect import Effect, EffectGroup
from scas4d_core.effects.evidence import Evidence
from scas4d_core.engines.renderer import Neighbourhoods
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians
from scas4d_core.update.parts import Attempt, PlanBuilder, UpdatePart

if TYPE_CHECKING:
    from scas4d_core.effects.evidence import FrameObservation

FEW = 4
"""Number of views from which the evidence is computed."""


class DirectionPart(UpdatePart):
    """Rotates the gloss with the deformation. Does nothing in a scene without gloss."""

    def __init__(self, builder: PlanBuilder) -> None:
        self._roots = builder.first.means
        self._near: Neighbourhoods | None = None

    def end(self, attempt: Attempt, state: Gaussians) -> Gaussians:
        """Rotates the gloss of each Gaussian in Θ_t with its neighbourhood, if the state moved."""
        if state.gloss is None or state.environment is None or attempt.kept is Candidate.PREVIOUS:
            return state
        if self._near is None:
            self._near = Neighbourhoods(self._roots[: len(state.gloss)])
        return attempt.renderer.turn_normals(attempt.previous, state, self._near)


@dataclass(frozen=True)
class Direction(Effect):
    """View-dependent colour, which is off unless frame 0 provides evidence."""

    def evidence(self, seen: FrameObservation) -> Evidence | None:
        """Returns the share of the squared image error in a few views that the gloss removes."""
        from scas4d_core.update.best_state import spread_cameras

        if seen.before.gloss is None:
            return None
        state = seen.result.gaussians
        matte = state.replace(gloss=None, environment=None)
        chosen = set(spread_cameras(seen.rig, [view.name for view in seen.views], FEW))
        views = [view for view in seen.views if view.name in chosen]
        plain, glossy = (
            sum(10 ** (-one.psnr / 10) for one in seen.renderer.compare(shown, views)) for shown in (matte, state)
        )
        share = max(0.0, 1 - glossy / max(plain, 1e-12))
        return Evidence(share, f"view-dependent colour explains {100 * share:.0f}% of the residual")

    def register(self, builder: PlanBuilder) -> None:
        """Adds a ``DirectionPart`` and requests full images.

        Static surfaces must also be rendered, because their appearance can change from frame to frame too.
        """
        builder.plan.full_images = builder.plan.gloss = True
        builder.parts.append(DirectionPart(builder))


EFFECT = Direction(
    name="direction",
    group=EffectGroup.APPEARANCE,
    description="Colour depends on the viewing direction: glossy objects reflect lights and surroundings, which stay "
    "fixed while the objects move.",
    disambiguation="The environment sums to zero over the sphere; appearance that is the same from all directions is "
    "attributed to colour.",
    cost="two passes over the Gaussians per rendered view; a trial in frame 0, which takes 50% longer if the effect "
    "is switched on",
    auto=True,
    on_above=0.1,  # the trial measures 0.25 on `gloss` and at most 0.03 on the five objects
)
