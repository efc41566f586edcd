"""Parallel regions of the iterations of an update of the box, for a new process: no kernel may have been loaded."""

from __future__ import annotations

from box_scene import make_box, make_rig, moved, take_frame
from effect_cases import of_whole_pictures

from scas4d_core.engines.cpu.engine import CpuEngine
from scas4d_core.settings import UpdateSettings
from scas4d_core.structure.hierarchy import build_hierarchy
from scas4d_core.structure.neighbours import Neighbours
from scas4d_core.update.frame_update import FrameUpdate
from scas4d_core.update.view_factory import ViewFactory
from studies.kernels.regions import CountingEngine


def regions_of_box() -> list[int]:
    """Number of parallel regions of each iteration. The first ones of each view also filter its target."""
    counting, before, rig = CountingEngine(), make_box(), make_rig()
    settings = UpdateSettings(clusters=(2, 12, 48), iterations=18)
    hierarchy = build_hierarchy(before.means, before.moving, settings.clusters, 1)
    neighbours = Neighbours(before.means[hierarchy.rows], 20, 200.0)
    factory = ViewFactory(rig)
    updater = FrameUpdate(CpuEngine(), of_whole_pictures(factory, settings, hierarchy, before), neighbours)
    updater.run(before, factory.views(take_frame(1, 1.0, moved(before), rig, True), {}), None, 1.0, seed=1)
    return counting.regions
