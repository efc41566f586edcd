"""Prepares the updates of a scene: clusters and neighbours of moving Gaussians, and the components of active effects.

They are rebuilt when more Gaussians are found to move, when an effect is switched on or off, and when Gaussians are
added or retired. They are built from the scene's *roots*: Θ_0 plus the Gaussians added since, at the positions they
would have had in frame 0.
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
from scas4d_core.engines.choose import engine_of, resolve_device
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
"""Minimum average number of Gaussians per cluster, which caps the number of clusters: smaller ones fit noise."""
NEIGHBOURS = 20
"""Number of neighbours per Gaussian in the neighbour terms (Dynamic3DGaussians)."""
NEIGHBOUR_FALLOFF = 2000.0
"""Falloff of neighbour weights in 1/m²: a neighbour at distance d has weight exp(−falloff d²) (Dynamic3DGaussians)."""

MAX_BORN_SHARE = 0.5
"""Maximum number of Gaussians added to a scene, as a fraction of the number in frame 0; this limits memory use."""


@dataclass(frozen=True, eq=False)
class PreparedUpdate:
    """Input of the next update in addition to Θ_{t−1}, always replaced as a whole.

    Attributes:
        updater: updater with the active effects.
        carried: state carried over from the previous update.
        roots: Θ_0 plus the Gaussians added since.
    """

    updater: FrameUpdate
    carried: CarryOver
    roots: Gaussians

    @property
    def plan(self) -> UpdatePlan:
        """Plan of the next update."""
        return self.updater.plan

    def with_carry_over(self, **changes: Any) -> PreparedUpdate:
        """Returns a copy in which the given fields of the carry-over are replaced."""
        return replace(self, carried=replace(self.carried, **changes))


class Preparation:
    """Prepares the updates of a scene.

    Args:
        factory: factory of the scene's views.
        settings: settings of the scene.
        world: transform from the user's to the internal world.
        renderer: renderer of the scene's views.
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
        """Returns the switches of the effects after the first frame, and the arrays that the effects keep from it.

        Args:
            frame: first frame, at the resolution of the rig.
            result: fit of the first frame.
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
        """Returns the views of a frame, with the current estimates of camera poses and exposures.

        Masks are not read if no term uses them.

        Args:
            frame: frame at its original resolution.
            fixed: maps each camera to its [3, 2] colour gain and offset, as estimated in frame 0.
            prepared: current input of the next update.

        Raises:
            ValueError: see ``ViewFactory.views``.
        """
        effects = prepared.carried.effects
        self._factory.posed = rig_with_drift(self._factory.rig, effects)
        exposures = current_exposures(fixed, effects, self._factory.rig.names)
        return self._factory.views(self._factory.scaled(frame), exposures, prepared.plan.mask > 0)

    def rebuild(self, roots: Gaussians, carried: CarryOver) -> PreparedUpdate:
        """Rebuilds the input of the next update; carried-over motion is dropped if the clusters have changed.

        Args:
            roots: Θ_0 plus all Gaussians added since.
            carried: state carried over from the previous update.
        """
        # no switches are carried over if a report was lost
        known = {**first_switches(self._settings, 0), **carried.switches}
        switches = {
            name: replace(switch, on=switch.on and effect(name).refusal(self._settings) is None)
            for name, switch in known.items()
        }
        carried = replace(carried, switches=switches)  # a replay may use other settings than the scene
        updater, structure = self._updater(with_labels(roots, carried.labels), switches)
        if carried.structure != structure:
            carried = replace(carried, motion=None, structure=structure)
        return PreparedUpdate(updater, carried, roots)

    def _updater(self, roots: Gaussians, switches: Switches) -> tuple[FrameUpdate, int]:
        """Returns the updater on the engine of ``settings.device``, and the digest of its clusters and neighbours.

        Args:
            roots: roots with the current labels of moving Gaussians.
            switches: on/off state of each effect.
        """
        hierarchy = self._clusters(roots)
        builder = PlanBuilder(self._scene, self._settings.update, self._factory, hierarchy, roots)
        built = register_effects(builder, names_on(switches))
        if not built.plan.freedom.clusters:  # no cluster moves, so the cascade is not needed
            hierarchy = built.hierarchy = hierarchy.without_layers
        neighbours = self._neighbour_graph(roots, hierarchy) if built.plan.neighbour_terms else None
        updater = FrameUpdate(engine_of(resolve_device(self._settings.device)), built, neighbours)
        return updater, digest(hierarchy, neighbours)

    def _neighbour_graph(self, roots: Gaussians, hierarchy: Hierarchy) -> Neighbours:
        """Returns the neighbour graph of the current hierarchy."""
        if self._neighbours is None:
            self._neighbours = build_neighbours(roots.means[hierarchy.rows], NEIGHBOURS, NEIGHBOUR_FALLOFF)
        return self._neighbours

    def _clusters(self, first: Gaussians) -> Hierarchy:
        """Returns the hierarchy of the moving Gaussians; rebuilds it, and its neighbours, only after changes."""
        made = self._hierarchy_inputs
        if made is None or not all(map(np.array_equal, made, (first.means, first.moving))):
            update = self._settings.update
            self._hierarchy_inputs, self._neighbours = (first.means, first.moving), None
            self._hierarchy = build_hierarchy(*self._hierarchy_inputs, update.clusters, SMALLEST_CLUSTER, update.seed)
        return self._hierarchy

    def learn_labels(
        self, prepared: PreparedUpdate, newest: Gaussians, believed: Sequence[TrainingView]
    ) -> PreparedUpdate:
        """Rebuilds the update with newly detected moving Gaussians, for scenes without masks.

        A Gaussian that has moved once stays in the hierarchy. The labels become part of the state when the frame is
        committed. Changed labels produce a new hierarchy to which the previous motion does not apply, so the update is
        a cold start.

        Args:
            prepared: current input of the next update.
            newest: previous state Θ_{t−1}.
            believed: views of the frame to learn from.
        """
        carried = prepared.carried
        labels = learn_labels_from_motion(newest, carried.labels, carried.seen, believed, self._renderer)
        if labels is None:
            return prepared
        return self.rebuild(prepared.roots, replace(carried, labels=labels, motion=None))

    def after_frame(
        self, prepared: PreparedUpdate, seen: FrameObservation, may_change_population: bool
    ) -> tuple[UpdateResult, PreparedUpdate]:
        """Returns the final result of a frame that was learnt, and the input of the next update.

        Args:
            prepared: input of the update that produced the result.
            seen: observation of the frame, with the result of its update.
            may_change_population: whether Gaussians may be added or retired.
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
        """Applies the effects that add, retire or revive Gaussians to a result; non-finite results are skipped.

        Args:
            names: names of the effects that took part in the update.
            seen: observation of the frame, with the result of its update.

        Raises:
            ValueError: if an effect changed rows in a way that is not allowed.
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
        """Returns whether the difference between the two states is a motion rather than a jump."""
        return self._settings.update.cluster_map == "centred" and result.outcome is not FrameOutcome.RELOCATED


def _with_changed_rows(
    prepared: PreparedUpdate, before: Gaussians, result: UpdateResult, other_rows: bool
) -> PreparedUpdate:
    """Extends the roots, labels and effect arrays to match the Gaussians of a result.

    Args:
        prepared: input of the next update.
        before: Gaussians before the change.
        result: update result with the changed Gaussians.
        other_rows: whether Gaussians were added, retired or revived.
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
    """Adds the motion from the previous to the new state, expressed per cluster of the updater."""
    if seen.result.motion is None:
        return prepared
    before, now, hierarchy = seen.result.gaussians, result.gaussians, prepared.updater.hierarchy
    known = np.zeros(len(now), np.bool_)
    known[: len(before)] = seen.before.moving & before.moving
    motion = motion_between(hierarchy, seen.before, now, known[hierarchy.rows], seen.result.motion.seconds)
    return prepared.with_carry_over(motion=motion)


def _check_rows(name: str, before: UpdateResult, after: UpdateResult) -> None:
    """Raises ``ValueError`` if an effect changed rows that it must not change."""
    count, born = len(before.gaussians), len(after.gaussians) - len(before.gaussians)
    kept = born >= 0 and np.array_equal(after.gaussians.ids[:count], before.gaussians.ids)
    if not kept or (after.gaussians.ids[count:] != UNBORN).any():
        raise ValueError(
            f"effect {name}: rows were removed or reordered; use Gaussians.concatenate to add rows, or retire them"
        )
    had = 0 if before.parents is None else len(before.parents)
    if (0 if after.parents is None else len(after.parents)) != had + born:
        raise ValueError(f"effect {name}: parents must have one entry for each of {had + born} new Gaussians")
    if after.parents is not None and not ((after.parents >= NO_PARENT) & (after.parents < count - had)).all():
        raise ValueError(f"effect {name}: parents must be rows of the previous frame")


def _extend_rows(array: NDArray[Any], count: int, parents: NDArray[np.int64] | None) -> NDArray[Any]:
    """Returns an effect's array, with rows appended for added Gaussians if it has one row per Gaussian."""
    if parents is None or not array.ndim or len(array) != count:
        return array
    rows = array[np.maximum(parents, 0)]
    rows[parents == NO_PARENT] = 0
    return np.concatenate([array, rows])


def room_for_births(first: int, now: int) -> int:
    """Returns the number of Gaussians that may still be added.

    Args:
        first: number of Gaussians in frame 0.
        now: current number of Gaussians, including retired ones.

    >>> room_for_births(1000, 1400), room_for_births(1000, 1600)
    (100, 0)
    """
    return max(0, int((1 + MAX_BORN_SHARE) * first) - now)


def digest(hierarchy: Hierarchy, neighbours: Neighbours | None) -> int:
    """Returns the CRC-32 of the clusters and the neighbour graph."""
    arrays: list[NDArray[np.generic]] = [hierarchy.rows, *hierarchy.labels, *hierarchy.starts]
    if neighbours is not None:
        arrays += [neighbours.index, neighbours.weights, neighbours.distances]
    value = 0
    for array in arrays:
        value = crc32(np.ascontiguousarray(array).view(np.uint8).data, value)
    return value
