"""Entering objects: Gaussians are added where several cameras see something that the state does not explain."""

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
"""Minimum number of screened cameras that must see something new before all cameras are checked."""
SMALLEST = 0.003
"""Minimum share of new pixels in an image for a camera to count (200 of 256 x 256). Moving objects that are tracked
with a lag leave fewer new pixels."""
SHARE = 0.05
"""Minimum share of the squared error of all images that an object must explain to switch the effect on."""
WORTH = 0.01
"""Minimum share of the squared error that an object must explain for adding Gaussians while the effect is on."""
SURPLUS = 0.5
"""Minimum surplus of new over stale pixels, relative to the object's pixels; with less, the object has only moved."""
BORDER, SUDDEN = 0.5, 0.2
"""New objects enter across the image border. The first value is the minimum share of cameras in which an object touches
the border. The second is the minimum share of the error for an object that appears elsewhere. A limb that is tracked
with a lag can look like such an object; in `stage`, its share is 0.07."""
TINY = 1e-12
"""Lower bound on a sum of squared errors, to avoid division by zero."""
SETTLED = 4
"""Number of frames for which an added Gaussian is still refined outside the update."""
DENIED = 0.5
"""Maximum share of the cameras viewing an added Gaussian that may see something else in its place. If it is exceeded,
the Gaussian is retired. The share is checked once, after ``SETTLED`` frames."""
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
"""Initial carried arrays, before any Gaussian is added."""
NEWBORN_ARRAYS = ("newborn", "thing", "centres", "volumes", "places")
"""Names of the arrays that describe only the last frame; see ``NewbornTracking``."""
BUDGET = 0.1
"""Maximum number of Gaussians added in a frame, as a share of the existing ones."""


@dataclass(frozen=True, eq=False)
class EnteredThings:
    """Objects that have entered the scene, represented by their hull.

    Attributes:
        seen: novelty map of each camera.
        hull: hull of the accepted objects.
        share: share of the squared error that the objects explain.
        cameras: largest number of cameras that see the same object.
    """

    seen: Sequence[Novelty]
    hull: Hull
    share: float
    cameras: int


def find_entered(seen: FrameObservation) -> EnteredThings | None:
    """Returns the objects in a frame that the state does not contain, or None if there are none."""
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
    """Returns the [P] mask of means [P, 3] at which most cameras see no object."""
    against, asked = np.zeros(len(means), np.int64), np.zeros(len(means), np.int64)
    for one in seen:
        column, row, _, inside = pixels_inside(one.camera, means)
        asked += inside
        against += inside & one.stale[row, column]
    denied: Bool = (asked >= MIN_CAMERAS) & (against > DENIED * asked)
    return denied


def _record_newborns(found: EnteredThings, state: Gaussians, rows: NDArray[np.int64], left: Arrays) -> Arrays:
    """Returns the carried arrays, extended by the added and revived Gaussians in ``rows``."""
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
    """Adds Gaussians in frames that show objects missing from the state."""

    def evidence(self, seen: FrameObservation) -> Evidence | None:
        """Returns the share of the error that new objects explain, or the recorded share if added Gaussians exist."""
        if not seen.views:
            return None
        left = seen.result.carried.get(NAME)
        if left is not None and seen.result.gaussians.present[left["rows"]].any():
            return _evidence(float(left["share"]), int(left["cameras"]))
        things = find_entered(seen)
        return Evidence(0.0, "") if things is None else _evidence(things.share, things.cameras)

    def add_and_retire_gaussians(self, seen: FrameObservation) -> UpdateResult:
        """Adds or revives Gaussians for new objects, and refines or retires Gaussians added in recent frames."""
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
        """Adds the part that tracks objects added in the previous frame."""
        builder.parts.append(NewbornTracking(builder, NAME))


def _evidence(share: float, cameras: int) -> Evidence:
    return Evidence(
        share, f"an object entered: {cameras} cameras agree, and it explains {100 * share:.0f}% of the error"
    )


EFFECT = Entering(
    name=NAME,
    group=EffectGroup.PRESENCE,
    description="Objects enter the scene: Gaussians are added where several cameras see something unexplained.",
    disambiguation="Only pixels that no moving Gaussian covers count, minus those that the state covers wrongly.",
    cost="a check of the last renderings; when an object enters, about as much time as another update",
    auto=True,
    on_above=SHARE,
    off_below=WORTH,
    committed_arrays=tuple(NO_NEWBORNS),
)
