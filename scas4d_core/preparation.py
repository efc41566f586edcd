"""Prepares the updates of a scene: clusters and neighbours of what moves, and the parts of the effects that are on.

They are made anew where more is found to move, where an effect is switched, and where Gaussians come and go. They are
made of the scene's *roots*: Θ_0, with the Gaussians born since at the places that they would have had in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import WorldFrame
from scas4d_core.captures.frame import Frame
from scas4d_core.checkpoint import CarryOver
from scas4d_core.effects.appearance.camera_gain import current_exposures
from scas4d_core.effects.cameras.pose_drift import rig_with_drift
from scas4d_core.effects.coherence.floor import floor_inside
from scas4d_core.effects.effect import Effect, effect
from scas4d_core.effects.evidence import FrameObservation
from scas4d_core.effects.presence.motion_mask import learn_labels_from_motion, with_labels
from scas4d_core.effects.switches import (
    Switch,
    Switches,
    decide_switches,
    first_frame_arrays,
    first_switches,
    names_on,
    record_arrays,
    register_effects,
    switches_after_first_frame,
)
from scas4d_core.engines.choose import engine_of
from scas4d_core.engines.plan import UpdatePlan
from scas4d_core.engines.renderer import Renderer
from scas4d_core.engines.views import TrainingView
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.frame_outcome import FrameOutcome
from scas4d_core.gaussians import UNBORN, Gaussians
from scas4d_core.settings import Settings
from scas4d_core.storage.births import NO_PARENT, extend_roots
from scas4d_core.structure.hierarchy import Hierarchy, build_hierarchy
from scas4d_core.structure.neighbours import Neighbours, build_neighbours
from scas4d_core.update.frame_update import FrameUpdate
from scas4d_core.update.parts import Arrays, PlanBuilder
from scas4d_core.update.result import UpdateResult, UpdateTrace
from scas4d_core.update.view_factory import ViewFactory
from scas4d_core.update.warm_start import motion_between

SMALLEST_CLUSTER = 8
"""Gaussians of a cluster, on average, that the layers are capped to: the motion of fewer is noise."""
NEIGHBOURS = 20
"""Neighbours of a Gaussian in the terms that tie it to them (Dynamic3DGaussians)."""
NEIGHBOUR_FALLOFF = 2000.0
"""1/m²: the weight of a neighbour at a distance d is exp(−falloff d²) (Dynamic3DGaussians)."""

MAX_BORN_SHARE = 0.5
"""Of the Gaussians of frame 0, that may be born in a scene: memory is bounded."""


@dataclass(frozen=True, eq=False)
class PreparedUpdate:
    """All that the next update starts from, beside Θ_{t−1}. It is replaced as a whole, or not at all.

    Attributes:
        updater: updates frames, with the effects that are on.
        carried: what the update before left. roots: Θ_0, with the Gaussians born since.
    """

    updater: FrameUpdate
    carried: CarryOver
    roots: Gaussians

    @property
    def plan(self) -> UpdatePlan:
        """The plan of its updates."""
        return self.updater.plan

    def with_carry_over(self, **changes: Any) -> PreparedUpdate:
        """The same with changes of what is carried over."""
        return replace(self, carried=replace(self.carried, **changes))


class Preparation:
    """Prepares the updates of a scene.

    Args:
        factory: of its views. settings: of the scene. world: user's to inside. renderer: draws.
    """

    def __init__(self, factory: ViewFactory, settings: Settings, world: WorldFrame, renderer: Renderer) -> None:
        self._factory, self._settings, self._renderer = factory, settings, renderer
        self._scene = settings.scene
        self._hierarchy_inputs: tuple[NDArray[np.float32], NDArray[np.bool_]] | None = None
        self._hierarchy: Hierarchy
        self._neighbours: Neighbours | None = None
        if self._scene.floor is not None:
            self._scene = self._scene.model_copy(update={"floor": floor_inside(self._scene.floor, world)})

    def first_frame_effects(self, frame: Frame, result: StaticResult) -> tuple[dict[str, Switch], dict[str, Arrays]]:
        """The switches of the effects after the first frame, and the arrays that they keep of it.

        Args:
            frame: the first, at the size of the rig. result: its fit.
        """
        switches = first_switches(self._settings, frame.index, result.evidence or {}, len(frame.masks) > 0)
        views = self._factory.views(frame, result.exposures, use_masks=False)
        unmoved = UpdateResult(result.gaussians, None, UpdateTrace())
        seen = FrameObservation(frame.index, result.gaussians, unmoved, self._factory.rig, views, self._renderer)
        arrays = first_frame_arrays(switches, self._settings, seen)
        return switches_after_first_frame(arrays, switches, seen), arrays

    def views(
        self, frame: Frame, fixed: dict[str, NDArray[np.float32]], prepared: PreparedUpdate
    ) -> list[TrainingView]:
        """The views of a frame, with the poses and exposures of the cameras as they are known by now.

        Without masks where no term asks for them: they are not even read.

        Args:
            fixed: [3, 2] gain and offset of each camera, as frame 0 has them.

        Raises:
            ValueError: see ``ViewFactory.views``.
        """
        effects = prepared.carried.effects
        self._factory.posed = rig_with_drift(self._factory.rig, effects)
        exposures = current_exposures(fixed, effects, self._factory.rig.names)
        return self._factory.views(self._factory.scaled(frame), exposures, prepared.plan.mask > 0)

    def rebuild(self, roots: Gaussians, carried: CarryOver) -> PreparedUpdate:
        """Prepares the next update anew; a motion that belongs to other clusters is dropped from the carry-over.

        Args:
            roots: Θ_0 with all born since.
        """
        known = {**first_switches(self._settings, 0), **carried.switches}  # where a report was lost, none are carried
        switches = {
            name: replace(switch, on=switch.on and effect(name).refusal(self._settings) is None)
            for name, switch in known.items()
        }
        carried = replace(carried, switches=switches)  # a replay may have other settings than the scene
        updater, structure = self._updater(with_labels(roots, carried.labels), switches)
        if carried.structure != structure:
            carried = replace(carried, motion=None, structure=structure)
        return PreparedUpdate(updater, carried, roots)

    def _updater(self, roots: Gaussians, switches: Switches) -> tuple[FrameUpdate, int]:
        """The updater on the engine of ``settings.device``, and the digest of its clusters and neighbours.

        Args:
            roots: with the labels of the moving Gaussians.
        """
        hierarchy = self._clusters(roots)
        builder = PlanBuilder(self._scene, self._settings.update, self._factory, hierarchy, roots)
        built = register_effects(builder, names_on(switches))
        if not built.plan.freedom.clusters:  # no cascade either
            hierarchy = built.hierarchy = hierarchy.without_layers
        neighbours = self._neighbour_graph(roots, hierarchy) if built.plan.neighbour_terms else None
        updater = FrameUpdate(engine_of(self._settings.device), built, neighbours)
        return updater, digest(hierarchy, neighbours)

    def _neighbour_graph(self, roots: Gaussians, hierarchy: Hierarchy) -> Neighbours:
        """The graph of the hierarchy that was made last."""
        if self._neighbours is None:
            self._neighbours = build_neighbours(roots.means[hierarchy.rows], NEIGHBOURS, NEIGHBOUR_FALLOFF)
        return self._neighbours

    def _clusters(self, first: Gaussians) -> Hierarchy:
        """The hierarchy of what moves; that of the updater before where the same Gaussians do, with its neighbours."""
        made = self._hierarchy_inputs
        if made is None or not all(map(np.array_equal, made, (first.means, first.moving))):
            update = self._settings.update
            self._hierarchy_inputs, self._neighbours = (first.means, first.moving), None
            self._hierarchy = build_hierarchy(*self._hierarchy_inputs, update.clusters, SMALLEST_CLUSTER, update.seed)
        return self._hierarchy

    def learn_labels(
        self, prepared: PreparedUpdate, newest: Gaussians, believed: Sequence[TrainingView]
    ) -> PreparedUpdate:
        """Prepared anew with the Gaussians that the pictures show to move, for scenes without masks.

        A Gaussian that has moved once stays in the hierarchy. The labels become part of the state with the commit of
        the frame. A hierarchy of other Gaussians is a new one: the motion before does not fit it, and the update
        starts cold.

        Args:
            newest: Θ_{t−1}. believed: views of the frame.
        """
        carried = prepared.carried
        labels = learn_labels_from_motion(newest, carried.labels, carried.seen, believed, self._renderer)
        if labels is None:
            return prepared
        return self.rebuild(prepared.roots, replace(carried, labels=labels, motion=None))

    def after_frame(
        self, prepared: PreparedUpdate, seen: FrameObservation, may_change_population: bool
    ) -> tuple[UpdateResult, PreparedUpdate]:
        """The result of a frame that was learnt, and what the next update starts from.

        Args:
            seen: the frame. may_change_population: whether Gaussians may come and go.
        """
        on, seen = names_on(prepared.carried.switches), record_arrays(prepared.carried.switches, self._settings, seen)
        switches = decide_switches(prepared.carried.switches, self._settings, seen)
        prepared = prepared.with_carry_over(effects=seen.result.carried, switches=switches)
        result = self.add_and_retire_gaussians(on, seen) if may_change_population else seen.result
        before, now = seen.result.gaussians, result.gaussians
        other_rows = len(now) != len(before) or not np.array_equal(now.retired, before.retired)
        if result is not seen.result:
            prepared = _with_changed_rows(prepared, before, result, other_rows)
        if other_rows or names_on(switches) != on:
            prepared = self.rebuild(prepared.roots, prepared.carried)
        if other_rows and prepared.carried.motion is None and self._is_motion(result):
            prepared = _with_motion(prepared, seen, result)
        return result, prepared

    def add_and_retire_gaussians(self, names: Sequence[str], seen: FrameObservation) -> UpdateResult:
        """The result of a frame with all that is born, retired or revived in it; what is not finite is left out.

        Args:
            names: of the effects that took part in its update. seen: the frame.

        Raises:
            ValueError: an effect has changed rows otherwise.
        """
        for name in names:
            one = effect(name)
            if type(one).add_and_retire_gaussians is not Effect.add_and_retire_gaussians:
                result = one.add_and_retire_gaussians(seen)
                _check_rows(name, seen.result, result)
                arrays = result.gaussians.arrays().values()
                if all(np.isfinite(array).all() for array in arrays if array.dtype.kind == "f"):
                    born = len(result.gaussians) - len(seen.result.gaussians)
                    seen = replace(seen, result=result, room=max(0, seen.room - born))
        return seen.result

    def _is_motion(self, result: UpdateResult) -> bool:
        """Whether the difference of two states is a motion; a jump is none."""
        return self._settings.update.cluster_map == "centred" and result.outcome is not FrameOutcome.RELOCATED


def _with_changed_rows(
    prepared: PreparedUpdate, before: Gaussians, result: UpdateResult, other_rows: bool
) -> PreparedUpdate:
    """With the roots, labels and arrays of effects of the Gaussians of a result.

    Args:
        before: the Gaussians before any came or went. other_rows: whether any did.
    """
    now, labels = result.gaussians, prepared.carried.labels
    effects = {
        name: {key: _extend_rows(array, len(before), result.parents) for key, array in arrays.items()}
        for name, arrays in result.carried.items()
    }
    if not other_rows:
        return prepared.with_carry_over(effects=effects)
    if labels is not None:
        labels = np.concatenate([labels, now.foreground[len(labels) :] > 0.5])
    prepared = prepared.with_carry_over(effects=effects, labels=labels)
    return replace(prepared, roots=extend_roots(prepared.roots, now, result.parents))


def _with_motion(prepared: PreparedUpdate, seen: FrameObservation, result: UpdateResult) -> PreparedUpdate:
    """With the motion between the two states, in the clusters of the updater."""
    if seen.result.motion is None:
        return prepared
    before, now, hierarchy = seen.result.gaussians, result.gaussians, prepared.updater.hierarchy
    known = np.zeros(len(now), np.bool_)
    known[: len(before)] = seen.before.moving & before.moving
    motion = motion_between(hierarchy, seen.before, now, known[hierarchy.rows], seen.result.motion.seconds)
    return prepared.with_carry_over(motion=motion)


def _check_rows(name: str, before: UpdateResult, after: UpdateResult) -> None:
    """Raises where an effect has changed rows that it may not change."""
    count, born = len(before.gaussians), len(after.gaussians) - len(before.gaussians)
    kept = born >= 0 and np.array_equal(after.gaussians.ids[:count], before.gaussians.ids)
    if not kept or (after.gaussians.ids[count:] != UNBORN).any():
        raise ValueError(
            f"effect {name}: rows were lost or moved; append with Gaussians.concatenate, retire the others"
        )
    had = 0 if before.parents is None else len(before.parents)
    if (0 if after.parents is None else len(after.parents)) != had + born:
        raise ValueError(f"effect {name}: parents has not one parent for each of {had + born} that are born")
    if after.parents is not None and not ((after.parents >= NO_PARENT) & (after.parents < count - had)).all():
        raise ValueError(f"effect {name}: a parent is no row of the frame before")


def _extend_rows(array: NDArray[Any], count: int, parents: NDArray[np.int64] | None) -> NDArray[Any]:
    """An array of an effect with rows for the born, where it has one for each Gaussian."""
    if parents is None or not array.ndim or len(array) != count:
        return array
    rows = array[np.maximum(parents, 0)]
    rows[parents == NO_PARENT] = 0
    return np.concatenate([array, rows])


def room_for_births(first: int, now: int) -> int:
    """The number of Gaussians that may still be born.

    Args:
        first: that frame 0 had. now: that there are, retired ones too.

    >>> room_for_births(1000, 1400), room_for_births(1000, 1600)
    (100, 0)
    """
    return max(0, int((1 + MAX_BORN_SHARE) * first) - now)


def digest(hierarchy: Hierarchy, neighbours: Neighbours | None) -> int:
    """CRC-32 of the clusters and the neighbour graph."""
    arrays: list[NDArray[np.generic]] = [hierarchy.rows, *hierarchy.labels, *hierarchy.starts]
    if neighbours is not None:
        arrays += [neighbours.index, neighbours.weights, neighbours.distances]
    value = 0
    for array in arrays:
        value = crc32(np.ascontiguousarray(array).view(np.uint8).data, value)
    return value
