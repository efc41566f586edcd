"""A small scene that is updated with chosen effects."""

from __future__ import annotations

import numpy as np
from box_scene import make_box, make_rig, moved, take_frame
from scas4d_core.effects.coherence.neighbour_terms import NeighbourTerms

from scas4d_core.effects.switches import first_switches, joined, names_on
from scas4d_core.gaussians import Gaussians
from scas4d_core.preparation import SMALLEST_CLUSTER
from scas4d_core.settings import SceneSettings, Settings, UpdateSettings
from scas4d_core.structure.hierarchy import Hierarchy, build_hierarchy
from scas4d_core.structure.neighbours import build_neighbours
from scas4d_core.update.frame_update import FrameUpdate
from scas4d_core.update.parts import PartsBuilder
from scas4d_core.update.view_factory import ViewFactory

BEFORE = make_box()
RIG = make_rig()
UPDATE = UpdateSettings(clusters=(2, 12), iterations=8)


def builder(scene: SceneSettings | None = None, update: UpdateSettings = UPDATE) -> PartsBuilder:
    hierarchy = build_hierarchy(BEFORE.means, BEFORE.moving, update.clusters, SMALLEST_CLUSTER)
    return PartsBuilder(scene or SceneSettings(), update, ViewFactory(RIG), hierarchy, BEFORE)


def of_whole_pictures(
    factory: ViewFactory, update: UpdateSettings, hierarchy: Hierarchy, first: Gaussians
) -> PartsBuilder:
    """The parts with which every Gaussian of a scene without evidence learns from every pixel."""
    settings = Settings.model_validate({"effects": {"standing_colour": "on"}}).model_copy(update={"update": update})
    return joined(
        PartsBuilder(SceneSettings(), update, factory, hierarchy, first), names_on(first_switches(settings, 0))
    )


def updated(effects: list[str], update: UpdateSettings = UPDATE) -> dict[str, np.ndarray]:
    """The arrays after an update of the box with these effects."""
    parts = joined(builder(update=update), effects)
    hierarchy = parts.hierarchy
    neighbours = build_neighbours(BEFORE.means[hierarchy.rows], 20, 200.0) if parts.find(NeighbourTerms) else None
    updater = FrameUpdate(parts.factory, parts.scene, update, hierarchy, neighbours, BEFORE, parts)
    views = parts.factory.views(take_frame(1, 1.0, moved(BEFORE), RIG, True), {})
    return updater.run(BEFORE, views, None, 1.0, seed=3).gaussians.arrays()


def same(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    return all(np.array_equal(a[name], b[name]) for name in a)
