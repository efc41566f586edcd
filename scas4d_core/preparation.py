"""Prepares the updates of a scene.

An update needs the clusters and neighbours of the moving Gaussians, and the components of the
active effects. These are rebuilt when more Gaussians are found to move and when an effect is
switched on or off. They are also rebuilt when Gaussians are added, retired or revived. Clusters
and neighbours are computed from the *roots* of the scene: Θ_0 plus all Gaussians added since, at
the positions that the added Gaussians would have had in frame 0.
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
from scas4d_core.structure.neighbours import Neighbours
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
    """Everything that the next update needs in addition to Θ_{t−1} and the images.

    Objects of this class are never changed in place. A scene replaces the whole object.

    Attributes:
        updater: updater with the active effects.
        carried: state carried over from the previous update.
        roots: Θ_0 plus all Gaussians added since, as of frame 0.
    """

    updater: FrameUpdate
    carried: CarryOver
    roots: Gaussians

    @property
    def plan(self) -> UpdatePlan:
        """Plan of the next update."""
        return self.updater.plan

    def with_carry_over(self, **changes: Any) -> PreparedUpdate:
        """Returns a copy in which the given fields of ``carried`` are replaced."""
        return replace(self, carried=replace(self.carried, **changes))


class Preparation:
    """Builder of the input of updates (``PreparedUpdate``) for one scene.

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
        """Decides which effects the first frame switches on.

        Args:
            frame: first frame, at the resolution of the rig.
            result: fit of the first frame.

        Returns:
            The switches of the effects after the first frame, and the arrays of this frame that the
            effects need in later frames. Both are keyed by effect name.
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

        Masks are only read if a loss term uses them.

        Args:
            frame: frame at its original resolution.
            fixed: maps each camera name to the [3, 2] gain and offset of its colour channels, as
                estimated in frame 0.
            prepared: current input of the next update.

        Raises:
            ValueError: see ``ViewFactory.views``.
        """
        effects = prepared.carried.effects
        self._factory.posed = rig_with_drift(self._factory.rig, effects)
        exposures = current_exposures(fixed, effects, self._factory.rig.names)
        return self._factory.views(self._factory.scaled(frame), exposures, prepared.plan.mask > 0)

    def rebuild(self, roots: Gaussians, carried: CarryOver) -> PreparedUpdate:
        """Rebuilds the input of the next update.

        If the clusters or neighbours have changed, the motion in ``carried`` does not apply to them
        and is dropped.

        Args:
            roots: Θ_0 plus all Gaussians added since, as of frame 0.
            carried: state carried over from the previous update.
        """
        # If a report was lost, switches may be missing in ``carried``.
        known = {**first_switches(self._settings, 0), **carried.switches}
        switches = {
            name: replace(switch, on=switch.on and effect(name).refusal(self._settings) is None)
            for name, switch in known.items()
        }
        # An effect that was on may now be refused, because a replay may use other settings.
        carried = replace(carried, switches=switches)
        updater, structure = self._updater(with_labels(roots, carried.labels), switches)
        if carried.structure != structure:
            carried = replace(carried, motion=None, structure=structure)
        return PreparedUpdate(updater, carried, roots)

    def _updater(self, roots: Gaussians, switches: Switches) -> tuple[FrameUpdate, int]:
        """Builds an updater on the engine of ``settings.device``.

        Args:
            roots: roots with the current labels of moving Gaussians.
            switches: on/off state of each effect.

        Returns:
            The updater, and the digest of its clusters and neighbours.
        """
        hierarchy = self._clusters(roots)
        builder = PlanBuilder(self._scene, self._settings.update, self._factory, hierarchy, roots)
        built = register_effects(builder, names_on(switches))
        if not built.plan.freedom.clusters:  # clusters are not needed if no effect moves them
            hierarchy = built.hierarchy = hierarchy.without_layers
        neighbours = self._neighbour_graph(roots, hierarchy) if built.plan.neighbour_terms else None
        updater = FrameUpdate(engine_of(resolve_device(self._settings.device)), built, neighbours)
        return updater, digest(hierarchy, neighbours)

    def _neighbour_graph(self, roots: Gaussians, hierarchy: Hierarchy) -> Neighbours:
        """Returns the neighbour graph of the current hierarchy, and builds it if necessary."""
        if self._neighbours is None:
            self._neighbours = Neighbours(roots.means[hierarchy.rows], NEIGHBOURS, NEIGHBOUR_FALLOFF)
        return self._neighbours

    def _clusters(self, first: Gaussians) -> Hierarchy:
        """Returns the hierarchy of the moving Gaussians.

        The hierarchy is rebuilt only if positions or labels of ``first`` have changed. The
        neighbour graph is then discarded, because its indices refer to the hierarchy.

        Args:
            first: roots with the current labels of moving Gaussians.
        """
        made = self._hierarchy_inputs
        if made is None or not all(map(np.array_equal, made, (first.means, first.moving))):
            update = self._settings.update
            self._hierarchy_inputs, self._neighbours = (first.means, first.moving), None
            self._hierarchy = build_hierarchy(*self._hierarchy_inputs, update.clusters, SMALLEST_CLUSTER, update.seed)
        return self._hierarchy

    def learn_labels(
        self, prepared: PreparedUpdate, newest: Gaussians, believed: Sequence[TrainingView]
    ) -> PreparedUpdate:
        """Detects moving Gaussians in a scene without masks.

        If there are new moving Gaussians, the input of the update is rebuilt.
        A Gaussian that has moved once stays in the hierarchy. The labels become part of the state
        when the frame is committed. New labels result in a new hierarchy. The previous motion does
        not apply to the new hierarchy, so the update is a cold start.

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
        """Adds and retires Gaussians after an update, and prepares the next update.

        Args:
            prepared: input of the update that produced the result.
            seen: observation of the frame, with the result of its update.
            may_change_population: whether Gaussians may be added, retired or revived.

        Returns:
            The final result of the frame, and the input of the next update.
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
        """Applies the effects that add, retire or revive Gaussians to the result of an update.

        The changes of an effect are ignored if its result contains values that are not finite.

        Args:
            names: names of the effects that took part in the update.
            seen: observation of the frame, with the result of its update.

        Raises:
            ValueError: if an effect removed or reordered rows, or returned invalid parents.
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
        """Returns whether the motion of a frame may be used for the next warm start.

        The result is false for a relocated object, which jumped instead of moving.
        """
        return self._settings.update.cluster_map == "centred" and result.outcome is not FrameOutcome.RELOCATED


def _with_changed_rows(
    prepared: PreparedUpdate, before: Gaussians, result: UpdateResult, other_rows: bool
) -> PreparedUpdate:
    """Extends roots, labels and effect arrays after Gaussians were added, retired or revived.

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
    """Adds the motion from the previous to the new state, expressed in the clusters of the updater.

    Args:
        prepared: input of the next update, without motion.
        seen: observation of the frame, with the result before Gaussians were added and retired.
        result: final result of the frame.
    """
    if seen.result.motion is None:
        return prepared
    before, now, hierarchy = seen.result.gaussians, result.gaussians, prepared.updater.hierarchy
    known = np.zeros(len(now), np.bool_)
    known[: len(before)] = seen.before.moving & before.moving
    motion = motion_between(hierarchy, seen.before, now, known[hierarchy.rows], seen.result.motion.seconds)
    return prepared.with_carry_over(motion=motion)


def _check_rows(name: str, before: UpdateResult, after: UpdateResult) -> None:
    """Raises ``ValueError`` if an effect removed or reordered rows, or returned invalid parents."""
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
    """Appends rows for added Gaussians to an array of an effect.

    The row of an added Gaussian is a copy of its parent's row, or zero without a parent. An array
    that does not have one row per Gaussian is returned unchanged.

    Args:
        array: array of the effect.
        count: number of Gaussians before any were added.
        parents: [B] row of each added Gaussian's parent, or None if no Gaussian was added.
    """
    if parents is None or not array.ndim or len(array) != count:
        return array
    rows = array[np.maximum(parents, 0)]
    rows[parents == NO_PARENT] = 0
    return np.concatenate([array, rows])


def room_for_births(first: int, now: int) -> int:
    """Returns the number of Gaussians that may still be added to a scene.

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
        arrays += [neighbours.means, np.array([neighbours.count, neighbours.falloff])]
    value = 0
    for array in arrays:
        value = crc32(np.ascontiguousarray(array).view(np.uint8).data, value)
    return value
