"""Things that enter: where cameras agree that nothing the state has explains the pictures, Gaussians are born."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scas4d_core.effects.effect import Effect, EffectGroup
from scas4d_core.effects.evidence import Evidence
from scas4d_core.effects.presence.carving import Hull, carve_new, footprint
from scas4d_core.effects.presence.newborn_tracking import NewbornTracking
from scas4d_core.effects.presence.novelty import Novelty, novelty_of_views, screen_novelty
from scas4d_core.effects.presence.returning import find_returned, revive_returned
from scas4d_core.posed_pictures import pixels_inside
from scas4d_core.update.parts import Arrays

if TYPE_CHECKING:
    from scas4d_core.effects.evidence import FrameObservation
    from scas4d_core.gaussians import Gaussians
    from scas4d_core.update.parts import PlanBuilder
    from scas4d_core.update.result import UpdateResult

Bool = NDArray[np.bool_]

NAME = "entering"
MIN_CAMERAS = 2
"""Cameras of a glance that have to see something new before all are asked."""
SMALLEST = 0.003
"""Share of a camera's pixels that it must see as new to have a say: 200 of 256 x 256. What an update leaves behind of
things that move is smaller."""
SHARE = 0.05
"""Of the squared error of all pictures that a thing explains, from which it is one."""
WORTH = 0.01
"""The same, from which Gaussians are born once the effect is on."""
SURPLUS = 0.5
"""Of the pixels of things that are new, which must not be made up for by stale ones: else they came from there."""
BORDER, SUDDEN = 0.5, 0.2
"""What enters comes over the border of the pictures: of the cameras that see a thing, the share in which it touches it;
and the share of the error that a thing has to explain that appears in their middle. There, an update that has not
followed a limb shows one beside it: 0.07 in `stage`."""
TINY = 1e-12
"""Of a sum of squared errors: none."""
SETTLED = 4
"""Frames after its birth in which a Gaussian is still fitted beside the update."""
DENIED = 0.5
"""Share of the cameras that have what was born in view and see something else there, above which it is retired once it
is settled: it was an error."""
NONE = np.zeros(0, np.int64)
NO_NEWBORNS: Arrays = {
    "rows": NONE,
    "age": NONE,
    "newborn": NONE,
    "thing": NONE,
    "centres": np.zeros((0, 3)),
    "volumes": np.zeros(0),
    "places": np.zeros((0, 3), np.float32),
    "share": np.array(0.0),
    "cameras": np.array(0),
}
"""What is left before anything was born."""
NEWBORN_ARRAYS = ("newborn", "thing", "centres", "volumes", "places")
"""Arrays that are of the last frame alone, see ``NewbornTracking``."""
BUDGET = 0.1
"""Gaussians that are born in a frame at most, as a share of those that are there."""


@dataclass(frozen=True, eq=False)
class EnteredThings:
    """The hull of what has entered.

    Attributes:
        seen: what the cameras say. hull: of the things that count. share: of the squared error that they explain.
        cameras: that see them.
    """

    seen: Sequence[Novelty]
    hull: Hull
    share: float
    cameras: int


def find_entered(seen: FrameObservation) -> EnteredThings | None:
    """What a frame shows that the state does not have; None where there is nothing of the kind."""
    if sum(_says(one) for one in screen_novelty(seen, MIN_CAMERAS, new=SMALLEST)) < MIN_CAMERAS:
        return None
    everyone = novelty_of_views(seen, seen.views)
    hull = carve_new(everyone)
    total = sum(float(one.error.sum()) for one in everyone)
    kept, share, cameras, pixels = np.zeros(len(hull.points), np.bool_), 0.0, 0, 0
    for thing in np.unique(hull.things):
        mine = hull.things == thing
        shown = [one.new & footprint(one, hull.points[mine], hull.voxel) for one in everyone]
        explains = sum(float(one.error[where].sum()) for one, where in zip(everyone, shown, strict=True))
        explains /= max(total, TINY)
        see = [where for where in shown if where.sum() >= SMALLEST * where.size]
        at_border = sum(_at_border(where) for where in see) >= BORDER * len(see)
        if see and explains >= (WORTH if at_border else SUDDEN):
            kept |= mine
            share += explains
            cameras = max(cameras, len(see))
            pixels += sum(int(where.sum()) for where in shown)
    if not kept.any() or sum(one.surplus for one in everyone) < SURPLUS * pixels:
        return None
    return EnteredThings(everyone, hull.only(kept), share, cameras)


def _at_border(pixels: Bool) -> bool:
    return bool(pixels[[0, -1]].any() or pixels[:, [0, -1]].any())


def _says(one: Novelty) -> bool:
    return one.surplus >= SMALLEST * one.new.size


def _find_denied(seen: Sequence[Novelty], means: NDArray[np.float64]) -> Bool:
    """[P] the means in whose pixels most cameras see that nothing of the kind is there."""
    against, asked = np.zeros(len(means), np.int64), np.zeros(len(means), np.int64)
    for one in seen:
        column, row, _, inside = pixels_inside(one.camera, means)
        asked += inside
        against += inside & one.stale[row, column]
    denied: Bool = (asked >= MIN_CAMERAS) & (against > DENIED * asked)
    return denied


def _record_newborns(found: EnteredThings, state: Gaussians, rows: NDArray[np.int64], left: Arrays) -> Arrays:
    """The arrays that the births and returns of a frame add to those that were left; ``rows`` are theirs."""
    things = np.unique(found.hull.things)
    thing = found.hull.things[cKDTree(found.hull.points).query(state.means[rows])[1]]
    own = [state.means[rows[thing == n]] for n in things]
    return {
        "rows": np.concatenate([left["rows"], rows]),
        "age": np.concatenate([left["age"], np.zeros(len(rows), np.int64)]),
        "newborn": np.concatenate([left["newborn"], rows]),
        "thing": np.concatenate([left["thing"], len(left["centres"]) + np.searchsorted(things, thing)]),
        "centres": np.concatenate(
            [left["centres"], [found.hull.points[found.hull.things == n].mean(axis=0) for n in things]]
        ),
        "volumes": np.concatenate(
            [left["volumes"], [(found.hull.things == n).sum() * found.hull.voxel**3 for n in things]]
        ),
        "places": np.concatenate(
            [left["places"], [one.mean(axis=0) if len(one) else np.zeros(3, np.float32) for one in own]]
        ),
        "share": np.maximum(found.share, left["share"]),
        "cameras": np.maximum(found.cameras, left["cameras"]),
    }


@dataclass(frozen=True)
class Entering(Effect):
    """Births, in frames that show more than the state has."""

    def evidence(self, seen: FrameObservation) -> Evidence | None:
        """What is new explains so much; once something was born, what that explained, for as long as it is there."""
        if not seen.views:
            return None
        left = seen.result.carried.get(NAME)
        if left is not None and seen.result.gaussians.present[left["rows"]].any():
            return _evidence(float(left["share"]), int(left["cameras"]))
        things = find_entered(seen)
        return Evidence(0.0, "") if things is None else _evidence(things.share, things.cameras)

    def add_and_retire_gaussians(self, seen: FrameObservation) -> UpdateResult:
        """The result with the Gaussians that are born, and the newborn ones settled."""
        from scas4d_core.effects.presence.newborn_fit import fit_newborns, refine_newborns, sample_seeds

        result, things = seen.result, find_entered(seen)
        left = result.carried.get(NAME, NO_NEWBORNS)
        state, rng = result.gaussians, np.random.default_rng([seen.index, len(result.gaussians)])
        newborn = left["age"] < SETTLED
        settling = left["rows"][newborn & state.present[left["rows"]]]
        if len(settling):
            state = refine_newborns(state, settling, seen.views, seen.rig, seen.renderer, rng, seen.time)
        arrays = {**left, **{name: NO_NEWBORNS[name] for name in NEWBORN_ARRAYS}, "age": left["age"] + 1}
        parents = result.parents
        grown_up = left["rows"][(left["age"] == SETTLED) & state.present[left["rows"]]]
        if len(grown_up):
            denied = _find_denied(novelty_of_views(seen, seen.views), state.means[grown_up].astype(np.float64))
            state = state.retire(grown_up[denied]) if denied.any() else state
        if things is not None and state.retired.any():
            back = find_returned(things.seen, things.hull, state, seen.renderer)
            if back:
                state = revive_returned(state, back)
                arrays |= _record_newborns(things, state, np.concatenate([one.rows for one in back]), arrays)
                rest = ~np.isin(things.hull.things, [one.thing for one in back])
                things = replace(things, hull=things.hull.only(rest)) if rest.any() else None
        if things is not None:
            points, colours = sample_seeds(things.seen, things.hull, min(int(BUDGET * len(state)), seen.room), rng)
            things = things if len(points) else None
        born = None
        if things is not None:
            given = seen.views, seen.rig, seen.renderer, rng
            born = fit_newborns(state, points, colours, *given, moves=True, time=seen.time)
        if things is not None and born is not None:
            rows = np.arange(len(state), len(state) + len(born))
            state = state.concatenate(born)
            arrays |= _record_newborns(things, state, rows, arrays)
            alone = np.full(len(born), -1, np.int64)
            parents = alone if parents is None else np.concatenate([parents, alone])
        if state is result.gaussians and left is NO_NEWBORNS:
            return result
        return replace(result, gaussians=state, parents=parents, carried={**result.carried, NAME: arrays})

    def register(self, builder: PlanBuilder) -> None:
        """Adds the search for what was born in the frame before."""
        builder.parts.append(NewbornTracking(builder, NAME))


def _evidence(share: float, cameras: int) -> Evidence:
    return Evidence(share, f"a thing entered: {cameras} cameras agree, it explains {100 * share:.0f} % of the error")


EFFECT = Entering(
    name=NAME,
    group=EffectGroup.PRESENCE,
    description="Objects enter the scene: Gaussians are added where cameras agree that nothing explains the pictures.",
    disambiguation="Only what no Gaussian covers, beyond what has moved away elsewhere.",
    cost="a check of the last rendered pictures; where something enters, about an update more",
    auto=True,
    on_above=SHARE,
    off_below=WORTH,
    committed_arrays=tuple(NO_NEWBORNS),
)
