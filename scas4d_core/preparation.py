"""Prepares the updates of a scene: clusters and neighbours of what moves, and the parts of the effects that are on.

They are made anew where more is found to move, and where an effect is switched.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import WorldFrame
from scas4d_core.effects.coherence.floor import floor_inside
from scas4d_core.effects.coherence.neighbour_terms import NeighbourTerms
from scas4d_core.effects.evidence import Seen
from scas4d_core.effects.parts import PartsBuilder
from scas4d_core.effects.registry import EFFECTS
from scas4d_core.effects.switches import Switches, decided, first_switches, joined, names_on
from scas4d_core.gaussians import Gaussians
from scas4d_core.settings import Settings
from scas4d_core.storage.checkpoint import CarryOver
from scas4d_core.structure.hierarchy import Hierarchy, build_hierarchy
from scas4d_core.structure.motion_mask import labelled, labels_learnt
from scas4d_core.structure.neighbours import Neighbours, build_neighbours
from scas4d_core.update.frame_update import FrameUpdate, Updater
from scas4d_core.update.picture_loss import PictureLoss, TrainingView, ViewFactory

SMALLEST_CLUSTER = 8
"""Gaussians of a cluster, on average, that the layers are capped to: the motion of fewer is noise."""
NEIGHBOURS = 20
"""Neighbours of a Gaussian in the terms that tie it to them (Dynamic3DGaussians)."""
NEIGHBOUR_FALLOFF = 2000.0
"""1/m²: the weight of a neighbour at a distance d is exp(−falloff d²) (Dynamic3DGaussians)."""


class Preparation:
    """Makes the updaters of a scene.

    Args:
        factory: of its views. settings: of the scene. world: user's to inside. picture: renders.

    Attributes:
        parts: of the updater that was made last.
    """

    parts: PartsBuilder

    def __init__(self, factory: ViewFactory, settings: Settings, world: WorldFrame, picture: PictureLoss) -> None:
        self._factory, self._settings, self._picture = factory, settings, picture
        self._scene = settings.scene
        if self._scene.floor is not None:
            self._scene = self._scene.model_copy(update={"floor": floor_inside(self._scene.floor, world)})

    def updater(self, first: Gaussians, switches: Switches) -> tuple[Updater, int]:
        """The updater of ``settings.device``, and the digest of its clusters and neighbours.

        Args:
            first: Θ_0, with the labels to go by. switches: of the effects.
        """
        update = self._settings.update
        hierarchy = build_hierarchy(first.means, first.moving, update.clusters, SMALLEST_CLUSTER, update.seed)
        parts = joined(PartsBuilder(self._scene, update, self._factory, hierarchy, first), names_on(switches))
        self.parts = parts
        if not parts.freedom.clusters:  # no cascade either
            hierarchy = hierarchy.without_layers
        tied = parts.find(NeighbourTerms) is not None
        neighbours = build_neighbours(first.means[hierarchy.rows], NEIGHBOURS, NEIGHBOUR_FALLOFF) if tied else None
        given = (self._factory, self._scene, update, hierarchy, neighbours, first, parts)
        structure = digest(hierarchy, neighbours)
        if self._settings.device == "cpu":
            return FrameUpdate(*given), structure
        from scas4d_core.torch_backend.device_update import DeviceUpdate  # torch is loaded only where it is used

        return DeviceUpdate(*given, device=self._settings.device), structure

    def again(self, first: Gaussians, carried: CarryOver) -> tuple[Updater, CarryOver]:
        """The updater for a carry-over; a motion that belongs to other clusters is dropped from that.

        Args:
            first: Θ_0.
        """
        # An earlier version left no switches, or not those of effects that are new.
        switches = {**first_switches(self._settings, 0), **carried.switches}
        carried = replace(carried, switches={name: switches[name] for name in EFFECTS})
        updater, structure = self.updater(labelled(first, carried.labels), carried.switches)
        same = carried.structure == structure
        return updater, carried if same else replace(carried, motion=None, structure=structure)

    def relabelled(
        self,
        updater: Updater,
        carried: CarryOver,
        newest: Gaussians,
        first: Gaussians,
        believed: Sequence[TrainingView],
    ) -> tuple[Updater, CarryOver]:
        """The updater and carry-over with the Gaussians that the pictures show to move, for scenes without masks.

        A Gaussian that has moved once stays in the hierarchy. The labels become part of the state with the commit of
        the frame. A hierarchy of other Gaussians is a new one: the motion before does not fit it, and the update
        starts cold.

        Args:
            newest: Θ_{t−1}. first: Θ_0. believed: views of the frame.
        """
        labels = labels_learnt(newest, carried.labels, carried.seen, believed, self._picture)
        if labels is None:
            return updater, carried
        return self.again(first, replace(carried, labels=labels, motion=None))

    def switched(self, updater: Updater, carried: CarryOver, seen: Seen, first: Gaussians) -> tuple[Updater, CarryOver]:
        """The updater and carry-over of the next frame, with the effects that a frame calls for.

        Args:
            seen: the frame. first: Θ_0.
        """
        switches = decided(carried.switches, self._settings, seen)
        before, carried = names_on(carried.switches), replace(carried, switches=switches)
        return (updater, carried) if names_on(switches) == before else self.again(first, carried)


def digest(hierarchy: Hierarchy, neighbours: Neighbours | None) -> int:
    """CRC-32 of the clusters and the neighbour graph."""
    arrays: list[NDArray[np.generic]] = [hierarchy.rows, *hierarchy.labels, *hierarchy.starts]
    if neighbours is not None:
        arrays += [neighbours.index, neighbours.weights, neighbours.distances]
    value = 0
    for array in arrays:
        value = crc32(np.ascontiguousarray(array).view(np.uint8).data, value)
    return value
