"""What effects put into the updates of a scene: values of the plan, and parts that act before and after an attempt.

What acts inside an iteration is a value of the plan, and the engine's work. A part acts on the host, once an attempt.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.limits import scene_limits
from scas4d_core.engines.plan import UpdatePlan
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians
from scas4d_core.update import schedule

if TYPE_CHECKING:
    from scas4d_core.engines.engine import Tables, UpdateEngine
    from scas4d_core.engines.renderer import Renderer
    from scas4d_core.engines.views import TrainingView
    from scas4d_core.settings import SceneSettings, UpdateSettings
    from scas4d_core.structure.hierarchy import Hierarchy
    from scas4d_core.update.rates import Rates
    from scas4d_core.update.view_factory import ViewFactory

Array = NDArray[np.float32]
Arrays = dict[str, NDArray[Any]]
NOTHING: Mapping[str, Arrays] = MappingProxyType({})
"""Arrays of no effect."""

P = TypeVar("P", bound="UpdatePart")


@dataclass(eq=False)
class Attempt:
    """One attempt at a frame, as parts see it.

    Attributes:
        engine: that computes it. renderer: draws states of the scene.
        previous: Θ_{t−1}. views: that it learns from. rates: of this attempt.
        tables: the start of the deformation; a part may change it in ``begin``.
        gains: [cameras, 3] that the engine starts with; None: it follows none.
        carried: arrays that the effects left at the frame before, by effect; in ``end`` parts replace them by those
            for the frame after.
        kept: the candidate that becomes Θ_t; known at the end.
    """

    engine: UpdateEngine
    renderer: Renderer
    previous: Gaussians
    views: Sequence[TrainingView]
    rates: Rates
    tables: Tables
    carried: dict[str, Arrays]
    gains: Array | None = None
    kept: Candidate = Candidate.END


class UpdatePart:
    """The work of one effect before and after the iterations; each method does nothing unless a part overrides it."""

    def begin(self, attempt: Attempt) -> None:
        """Called before the first iteration of an attempt."""

    def end(self, attempt: Attempt, state: Gaussians) -> Gaussians:
        """Called with Θ_t once it is chosen, and leaves ``attempt.carried`` for the frame after. Returns Θ_t."""
        return state


@dataclass(eq=False)
class PlanBuilder:
    """The plan and the parts of a scene's updates, while the effects that are on register with it.

    Attributes:
        scene, update: the settings, the floor inside. factory: of the scene's views. hierarchy: of the moving
            Gaussians. first: the roots, Θ_0 with all born since (``preparation``).
        plan: filled in by the effects. parts: of the effects, in order.
    """

    scene: SceneSettings
    update: UpdateSettings
    factory: ViewFactory
    hierarchy: Hierarchy
    first: Gaussians
    plan: UpdatePlan = field(init=False)
    parts: list[UpdatePart] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.plan = UpdatePlan(
            cameras=self.factory.rig.names,
            background=self.scene.background_rgb,
            limits=scene_limits(self.scene.near, self.factory.rig.radius),
            cluster_map=self.update.cluster_map,
            covariance=self.update.covariance,
            image=schedule.IMAGE_WEIGHT,
            soft_colour=schedule.SOFT_COLOUR_WEIGHT,
        )
