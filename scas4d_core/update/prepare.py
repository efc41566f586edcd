"""What the updates of a scene run on: clusters and neighbours of what moves, as frame 0 lay, and the updater."""

from __future__ import annotations

from zlib import crc32

import numpy as np

from scas4d_core.cameras import WorldFrame
from scas4d_core.gaussians import Gaussians
from scas4d_core.settings import Settings
from scas4d_core.structure.hierarchy import Hierarchy, build_hierarchy
from scas4d_core.structure.neighbours import Neighbours, build_neighbours
from scas4d_core.update.floor import floor_inside
from scas4d_core.update.frame_update import FrameUpdate, Updater
from scas4d_core.update.views import ViewFactory


def prepare(first: Gaussians, factory: ViewFactory, settings: Settings, world: WorldFrame) -> tuple[Updater, int]:
    """The updater of ``settings.device`` for the hierarchy and the neighbour graph of what moves; the digest of both.

    Args:
        first: Θ_0, with the labels to go by. factory: of the scene's views. world: user's to inside.
    """
    update = settings.update
    hierarchy = build_hierarchy(first.means, first.moving, update.clusters, update.smallest_cluster, update.seed)
    weights = update.weights
    tied = weights.rigidity + weights.isometry + weights.rotation > 0
    neighbours = (
        build_neighbours(first.means[hierarchy.rows], update.neighbours, update.neighbour_falloff) if tied else None
    )
    structure = digest(hierarchy, neighbours)
    scene = settings.scene
    if scene.floor is not None:
        scene = scene.model_copy(update={"floor": floor_inside(scene.floor, world)})
    given = (factory, scene, update, hierarchy, neighbours, first)
    if settings.device == "cpu":
        return FrameUpdate(*given), structure
    from scas4d_core.torch_backend.device_update import DeviceUpdate  # torch is loaded only where it is used

    return DeviceUpdate(*given, device=settings.device), structure


def digest(hierarchy: Hierarchy, neighbours: Neighbours | None) -> int:
    """CRC-32 of the clusters and the neighbour graph."""
    arrays = [hierarchy.rows, *hierarchy.labels, *hierarchy.starts]
    if neighbours is not None:
        arrays += [neighbours.index, neighbours.weights, neighbours.distances]
    value = 0
    for array in arrays:
        value = crc32(np.ascontiguousarray(array).view(np.uint8).data, value)
    return value
