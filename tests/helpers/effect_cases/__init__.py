"""A small scene that is updated with chosen effects."""

from __future__ import annotations

import numpy as np
from box_scene import make_box, make_rig, moved, take_frame

from scas4d_core.effects.switches import first_switches, names_on, register_effects
from scas4d_core.engines.cpu.engine import CpuEngine
from scas4d_core.engines.engine import UpdateEngine
from scas4d_core.gaussians import Gaussians
from scas4d_core.preparation import SMALLEST_CLUSTER
from scas4d_core.settings import SceneSettings, Settings, UpdateSettings
from scas4d_core.structure.hierarchy import Hierarchy, build_hierarchy
from scas4d_core.structure.neighbours import Neighbours
from scas4d_core.update.frame_update import FrameUpdate
from scas4d_core.update.parts import PlanBuilder
from scas4d_core.update.view_factory import ViewFactory

BEFORE = make_box()
RIG = make_rig()
UPDATE = UpdateSettings(clusters=(2, 12), iterations=8)


def builder(scene: SceneSettings | None = None, update: UpdateSettings = UPDATE) -> PlanBuilder:
    hierarchy = build_hierarchy(BEFORE.means, BEFORE.moving, update.clusters, SMALLEST_CLUSTER)
    return PlanBuilder(scene or SceneSettings(), update, ViewFactory(RIG), hierarchy, BEFORE)


def of_whole_pictures(
    factory: ViewFactory, update: UpdateSettings, hierarchy: Hierarchy, first: Gaussians
) -> PlanBuilder:
    """The plan with which every Gaussian of a scene without evidence learns from every pixel."""
    settings = Settings.model_validate({"effects": {"static_colour": "on"}}).model_copy(update={"update": update})
    return register_effects(
        PlanBuilder(SceneSettings(), update, factory, hierarchy, first), names_on(first_switches(settings, 0))
    )


def updater_of(built: PlanBuilder, engine: UpdateEngine | None = None) -> FrameUpdate:
    """The updater of what the effects have filled in, on an engine; None: that of the CPU."""
    rows = built.hierarchy.rows
    neighbours = Neighbours(built.first.means[rows], 20, 200.0) if built.plan.neighbour_terms else None
    return FrameUpdate(engine or CpuEngine(), built, neighbours)


def updated(effects: list[str], update: UpdateSettings = UPDATE) -> dict[str, np.ndarray]:
    """The arrays after an update of the box with these effects."""
    built = register_effects(builder(update=update), effects)
    views = built.factory.views(take_frame(1, 1.0, moved(BEFORE), RIG, True), {})
    return updater_of(built).run(BEFORE, views, None, 1.0, seed=3).gaussians.arrays()


def same(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    return all(np.array_equal(a[name], b[name]) for name in a)
