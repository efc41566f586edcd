"""Contributions of effects to updates: values of the plan, and parts that act before and after an attempt.

The engine executes the plan in each iteration. Parts run on the host, at the beginning and at the end of each attempt.
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
"""Empty mapping, used if no effect has arrays."""

P = TypeVar("P", bound="UpdatePart")


@dataclass(eq=False)
class Attempt:
    """One attempt at a frame, as seen by the parts.

    Attributes:
        engine: engine that computes the attempt.
        renderer: renderer for states of the scene.
        previous: previous state Θ_{t−1}.
        views: training views that the attempt uses.
        rates: learning rates of this attempt.
        tables: initial deformation; a part may replace it in ``begin``. The arrays may be read-only.
        carried: arrays from the previous frame, keyed by effect name. In ``end``, parts replace them with the arrays
            for the next frame.
        gains: [cameras, 3] initial camera gains, or None if gains are not estimated.
        kept: candidate that becomes Θ_t; valid in ``end``.
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
    """The contribution of one effect before and after the iterations. By default, it changes nothing."""

    def begin(self, attempt: Attempt) -> None:
        """Prepares the attempt before its first iteration."""

    def end(self, attempt: Attempt, state: Gaussians) -> Gaussians:
        """Returns Θ_t, modified if necessary, and updates ``attempt.carried`` for the next frame."""
        return state


@dataclass(eq=False)
class PlanBuilder:
    """Collects the plan and the parts of a scene's updates while the active effects register themselves.

    Attributes:
        scene: scene settings, with the floor in the internal world.
        update: update settings.
        factory: factory of the scene's training views.
        hierarchy: hierarchy of the moving Gaussians.
        first: root Gaussians: Θ_0 plus all Gaussians added since (``preparation``).
        plan: plan that the effects fill in.
        parts: parts of the effects, in order.
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
