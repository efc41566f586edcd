"""Prepares the updates of a scene: clusters and neighbours of what moves, and the parts of the effects that are on.

They are made anew where more is found to move, where an effect is switched, and where Gaussians come and go. They are
made of the scene's *roots*: Θ_0, with the Gaussians born since at the places that they would have had in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import WorldFrame
from scas4d_core.captures.frame import Frame
from scas4d_core.checkpoint import CarryOver
from scas4d_core.effects.appearance.camera_gain import known_gains
from scas4d_core.effects.cameras.pose_drift import posed
from scas4d_core.effects.coherence.floor import floor_inside
from scas4d_core.effects.coherence.neighbour_terms import NeighbourTerms
from scas4d_core.effects.effect import Effect, effect
from scas4d_core.effects.evidence import Seen
from scas4d_core.effects.parts import Arrays, PartsBuilder
from scas4d_core.effects.presence.motion_mask import labelled, labels_learnt
from scas4d_core.effects.registry import EFFECTS
from scas4d_core.effects.switches import (
    Switch,
    Switches,
    began,
    decided,
    first_switches,
    joined,
    names_on,
    noted,
    refusal,
    switched_by,
)
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.frame_outcome import FrameOutcome
from scas4d_core.gaussians import UNBORN, Gaussians
from scas4d_core.settings import Settings
from scas4d_core.storage.births import FOUNDERLESS, grown_roots
from scas4d_core.structure.hierarchy import Hierarchy, build_hierarchy
from scas4d_core.structure.neighbours import Neighbours, build_neighbours
from scas4d_core.update.frame_update import FrameUpdate, Updater
from scas4d_core.update.picture_loss import PictureLoss, ViewFactory
from scas4d_core.update.result import UpdateResult, UpdateTrace
from scas4d_core.update.training_view import TrainingView
from scas4d_core.update.warm_start import motion_between

SMALLEST_CLUSTER = 8
"""Gaussians of a cluster, on average, that the layers are capped to: the motion of fewer is noise."""
NEIGHBOURS = 20
"""Neighbours of a Gaussian in the terms that tie it to them (Dynamic3DGaussians)."""
NEIGHBOUR_FALLOFF = 2000.0
"""1/m²: the weight of a neighbour at a distance d is exp(−falloff d²) (Dynamic3DGaussians)."""

MOST_BORN = 0.5
"""Of the Gaussians of frame 0, that may be born in a scene: memory is bounded."""


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
        self._made_of: tuple[NDArray[np.float32], NDArray[np.bool_]] | None = None
        self._hierarchy: Hierarchy
        self._neighbours: Neighbours | None = None
        if self._scene.floor is not None:
            self._scene = self._scene.model_copy(update={"floor": floor_inside(self._scene.floor, world)})

    def begun(self, frame: Frame, result: StaticResult) -> tuple[dict[str, Switch], dict[str, Arrays]]:
        """The switches of the effects after the first frame, and the arrays that they keep of it.

        Args:
            frame: the first, at the size of the rig. result: its fit.
        """
        switches = first_switches(self._settings, frame.index, result.evidence or {}, len(frame.masks) > 0)
        views = self._factory.views(frame, result.exposures, use_masks=False)
        found = UpdateResult(result.gaussians, None, UpdateTrace())
        seen = Seen(frame.index, result.gaussians, found, self._factory.rig, views, self._picture)
        arrays = began(switches, self._settings, seen)
        return switched_by(arrays, switches, seen), arrays

    def views(self, frame: Frame, fixed: dict[str, NDArray[np.float32]], carried: CarryOver) -> list[TrainingView]:
        """The views of a frame, with the poses and exposures of the cameras as they are known by now.

        Without masks where no term asks for them: they are not even read.

        Args:
            fixed: [3, 2] gain and offset of each camera, that frame 0 found.

        Raises:
            ValueError: see ``ViewFactory.views``.
        """
        self._factory.posed = posed(self._factory.rig, carried.effects)
        exposures = known_gains(fixed, carried.effects, self._factory.rig.names)
        return self._factory.views(self._factory.scaled(frame), exposures, self.parts.mask > 0)

    def updater(self, first: Gaussians, switches: Switches) -> tuple[Updater, int]:
        """The updater of ``settings.device``, and the digest of its clusters and neighbours.

        Args:
            first: the roots, with the labels to go by. switches: of the effects.
        """
        update = self._settings.update
        hierarchy = self._clusters(first)
        parts = joined(PartsBuilder(self._scene, update, self._factory, hierarchy, first), names_on(switches))
        self.parts = parts
        if not parts.freedom.clusters:  # no cascade either
            hierarchy = hierarchy.without_layers
        tied = parts.find(NeighbourTerms) is not None
        if tied and self._neighbours is None:
            self._neighbours = build_neighbours(first.means[hierarchy.rows], NEIGHBOURS, NEIGHBOUR_FALLOFF)
        neighbours = self._neighbours if tied else None
        given = (self._factory, self._scene, update, hierarchy, neighbours, first, parts)
        structure = digest(hierarchy, neighbours)
        if self._settings.device == "cpu":
            return FrameUpdate(*given), structure
        from scas4d_core.torch_backend.device_update import DeviceUpdate  # torch is loaded only where it is used

        return DeviceUpdate(*given, device=self._settings.device), structure

    def _clusters(self, first: Gaussians) -> Hierarchy:
        """The hierarchy of what moves; that of the updater before where the same Gaussians do, with its neighbours."""
        made = self._made_of
        if made is None or not all(map(np.array_equal, made, (first.means, first.moving))):
            update = self._settings.update
            self._made_of, self._neighbours = (first.means, first.moving), None
            self._hierarchy = build_hierarchy(*self._made_of, update.clusters, SMALLEST_CLUSTER, update.seed)
        return self._hierarchy

    def again(self, first: Gaussians, carried: CarryOver) -> tuple[Updater, CarryOver]:
        """The updater for a carry-over; a motion that belongs to other clusters is dropped from that.

        Args:
            first: the roots.
        """
        # An earlier version left no switches, or not those of effects that are new.
        switches = {**first_switches(self._settings, 0), **carried.switches}
        unknown = {name for name in EFFECTS if switches[name].on and refusal(name, self._settings) is not None}
        switches |= {name: replace(switches[name], on=False) for name in unknown}  # to another device than before
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
            newest: Θ_{t−1}. first: the roots. believed: views of the frame.
        """
        labels = labels_learnt(newest, carried.labels, carried.seen, believed, self._picture)
        if labels is None:
            return updater, carried
        return self.again(first, replace(carried, labels=labels, motion=None))

    def switched(self, updater: Updater, carried: CarryOver, seen: Seen, first: Gaussians) -> tuple[Updater, CarryOver]:
        """The updater and carry-over of the next frame, with the effects that a frame calls for.

        Args:
            seen: the frame. first: the roots.
        """
        switches = decided(carried.switches, self._settings, seen)
        before, carried = names_on(carried.switches), replace(carried, switches=switches)
        return (updater, carried) if names_on(switches) == before else self.again(first, carried)

    def followed(
        self, updater: Updater, carried: CarryOver, seen: Seen, first: Gaussians, populates: bool
    ) -> tuple[UpdateResult, Updater, CarryOver, Gaussians]:
        """What follows from a frame that was learnt: its result, and the updater, carry-over and roots of the next.

        Args:
            seen: the frame. first: the roots before. populates: whether Gaussians may come and go.
        """
        on, seen = names_on(carried.switches), noted(carried.switches, self._settings, seen)
        carried = replace(carried, effects=seen.result.carried)
        updater, carried = self.switched(updater, carried, seen, first)
        if not populates:
            return seen.result, updater, carried, first
        result = self.populated(on, seen)
        return result, *self.regrown(updater, carried, seen, result, first)

    def populated(self, names: Sequence[str], seen: Seen) -> UpdateResult:
        """The result of a frame with all that is born, retired or revived in it; what is not finite is left out.

        Args:
            names: of the effects that took part in its update. seen: the frame.

        Raises:
            ValueError: an effect has changed rows otherwise.
        """
        for name in names:
            one = effect(name)
            if type(one).populated is not Effect.populated:
                result = one.populated(seen)
                _check_rows(name, seen.result, result)
                arrays = result.gaussians.arrays().values()
                if all(np.isfinite(array).all() for array in arrays if array.dtype.kind == "f"):
                    born = len(result.gaussians) - len(seen.result.gaussians)
                    seen = replace(seen, result=result, room=max(0, seen.room - born))
        return seen.result

    def regrown(
        self, updater: Updater, carried: CarryOver, seen: Seen, result: UpdateResult, first: Gaussians
    ) -> tuple[Updater, CarryOver, Gaussians]:
        """The updater, carry-over and roots after a frame in which Gaussians have come or gone.

        Args:
            seen: the frame before they did. result: after. first: the roots before.
        """
        before, now = seen.result.gaussians, result.gaussians
        if result is seen.result:
            return updater, carried, first
        effects = {
            name: {key: _lengthened(array, len(before), result.joins) for key, array in arrays.items()}
            for name, arrays in result.carried.items()
        }
        carried = replace(carried, effects=effects)
        if len(now) == len(before) and np.array_equal(now.retired, before.retired):
            return updater, carried, first
        roots, labels = grown_roots(first, now, result.joins), carried.labels
        if labels is not None:
            labels = np.concatenate([labels, now.foreground[len(labels) :] > 0.5])
        updater, carried = self.again(roots, replace(carried, labels=labels))
        if carried.motion is None and seen.result.motion is not None and self._goes_on(result):
            rows = updater.hierarchy.rows
            known = np.zeros(len(now), np.bool_)
            known[: len(before)] = seen.before.moving & before.moving
            moved = motion_between(updater.hierarchy, seen.before, now, known[rows], seen.result.motion.seconds)
            carried = replace(carried, motion=moved)
        return updater, carried, roots

    def _goes_on(self, result: UpdateResult) -> bool:
        """Whether the difference of two states is a motion; a jump is none."""
        return self._settings.update.cluster_map == "centred" and result.outcome is not FrameOutcome.RELOCATED


def _check_rows(name: str, before: UpdateResult, after: UpdateResult) -> None:
    """Raises where an effect has changed rows that it may not change."""
    count, born = len(before.gaussians), len(after.gaussians) - len(before.gaussians)
    kept = born >= 0 and np.array_equal(after.gaussians.ids[:count], before.gaussians.ids)
    if not kept or (after.gaussians.ids[count:] != UNBORN).any():
        raise ValueError(f"effect {name}: rows were lost or moved; append with Gaussians.joined, retire the others")
    had = 0 if before.joins is None else len(before.joins)
    if (0 if after.joins is None else len(after.joins)) != had + born:
        raise ValueError(f"effect {name}: joins has not one founder for each of {had + born} that are born")
    if after.joins is not None and not ((after.joins >= FOUNDERLESS) & (after.joins < count - had)).all():
        raise ValueError(f"effect {name}: a founder is no row of the frame before")


def _lengthened(array: NDArray[Any], count: int, joins: NDArray[np.int64] | None) -> NDArray[Any]:
    """An array of an effect with rows for the born, where it has one for each Gaussian."""
    if joins is None or not array.ndim or len(array) != count:
        return array
    rows = array[np.maximum(joins, 0)]
    rows[joins == FOUNDERLESS] = 0
    return np.concatenate([array, rows])


def room_for_births(first: int, now: int) -> int:
    """The number of Gaussians that may still be born.

    Args:
        first: that frame 0 had. now: that there are, retired ones too.

    >>> room_for_births(1000, 1400), room_for_births(1000, 1600)
    (100, 0)
    """
    return max(0, int((1 + MOST_BORN) * first) - now)


def digest(hierarchy: Hierarchy, neighbours: Neighbours | None) -> int:
    """CRC-32 of the clusters and the neighbour graph."""
    arrays: list[NDArray[np.generic]] = [hierarchy.rows, *hierarchy.labels, *hierarchy.starts]
    if neighbours is not None:
        arrays += [neighbours.index, neighbours.weights, neighbours.distances]
    value = 0
    for array in arrays:
        value = crc32(np.ascontiguousarray(array).view(np.uint8).data, value)
    return value
