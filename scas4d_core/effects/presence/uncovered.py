"""Uncovered background: static Gaussians are added where moving objects uncover regions missing from the state."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np

from scas4d_core.effects.effect import Effect, EffectGroup
from scas4d_core.effects.evidence import Evidence
from scas4d_core.effects.presence.carving import footprint
from scas4d_core.effects.presence.novelty import novelty_of_views, screen_novelty
from scas4d_core.effects.presence.uncovered_points import UncoveredPoints, find_uncovered_points

if TYPE_CHECKING:
    from scas4d_core.effects.evidence import FrameObservation
    from scas4d_core.gaussians import Gaussians
    from scas4d_core.update.parts import Arrays, PlanBuilder
    from scas4d_core.update.result import UpdateResult

NAME = "uncovered"
MIN_CAMERAS, MIN_CAMERAS_WHILE_ON = 3, 1
"""Minimum number of screened cameras that must see a bare region before all cameras are checked, while the effect is
off and while it is on. Continued motion keeps uncovering background, and at first only a few cameras see a hole."""
SMALLEST = 0.0004
"""Minimum share of bare pixels in an image for a camera to count (26 of 256 x 256, about five by five pixels)."""
SHARE = 0.03
"""Minimum share of the squared error of all images that must be in bare regions to switch the effect on."""
WORTH = 0.005
"""Minimum share of the squared error in bare regions for adding Gaussians while the effect is on."""
BUDGET = 0.05
"""Maximum number of Gaussians added in a frame, as a share of the existing ones."""


Found = tuple[UncoveredPoints, float]
_points_cache: WeakKeyDictionary[Gaussians, dict[int, Found | None]] = WeakKeyDictionary()
"""Cached results for each state and minimum number of screened cameras, used as evidence and for adding Gaussians."""


def _find_points(seen: FrameObservation, glanced: int) -> Found | None:
    """Returns points on uncovered surfaces and the share of the squared error that they explain, or None.

    Args:
        seen: the learnt frame.
        glanced: minimum number of screened cameras that must see a bare region.
    """
    known = _points_cache.setdefault(seen.result.gaussians, {})
    if glanced not in known:
        known[glanced] = _looked_for(seen, glanced)
    return known[glanced]


def _looked_for(seen: FrameObservation, glanced: int) -> Found | None:
    if (
        sum(one.bare.sum() >= SMALLEST * one.bare.size for one in screen_novelty(seen, glanced, bare=SMALLEST))
        < glanced
    ):
        return None
    everyone = novelty_of_views(seen, seen.views)
    points = find_uncovered_points(everyone, seen.result.gaussians, seen.renderer)
    if not len(points.points):
        return None
    total = sum(float(one.error.sum()) for one in everyone)
    prints = [one.bare & footprint(one, points.points, points.spacing) for one in everyone]
    explains = sum(float(one.error[where].sum()) for one, where in zip(everyone, prints, strict=True))
    return (points, explains / total) if total > 0 else None


@dataclass(frozen=True)
class UncoveredEffect(Effect):
    """Adds static Gaussians behind moving objects."""

    def evidence(self, seen: FrameObservation) -> Evidence | None:
        """Returns the share of the squared error in bare regions.

        Once Gaussians have been added, fewer cameras need to see a region.
        """
        if not seen.views:
            return None
        points = _find_points(seen, MIN_CAMERAS_WHILE_ON if NAME in seen.result.carried else MIN_CAMERAS)
        return Evidence(0.0, "") if points is None else _evidence(points[1])

    def add_and_retire_gaussians(self, seen: FrameObservation) -> UpdateResult:
        """Adds Gaussians on the uncovered surfaces."""
        result, uncovered_points = seen.result, _find_points(seen, MIN_CAMERAS_WHILE_ON)
        if uncovered_points is None or uncovered_points[1] < WORTH:
            return result
        from scas4d_core.effects.presence.newborn_fit import fit_newborns

        points, share = uncovered_points
        state, rng = result.gaussians, np.random.default_rng([seen.index, len(result.gaussians)])
        some = np.arange(len(points.points))
        most = min(int(BUDGET * len(state)), seen.room)
        if most <= 0:
            return result
        if len(some) > most:
            some = np.sort(rng.choice(some, most, replace=False))
        given = seen.views, seen.rig, seen.renderer, rng
        born = fit_newborns(state, points.points[some], points.colours[some], *given, moves=False, time=seen.time)
        if born is None:
            return result
        parents = np.full(len(born), -1, np.int64)
        left = result.carried.get(NAME)
        arrays: Arrays = {"share": np.array(share if left is None else max(share, float(left["share"])))}
        return replace(
            result,
            gaussians=state.concatenate(born),
            parents=parents if result.parents is None else np.concatenate([result.parents, parents]),
            carried={**result.carried, NAME: arrays},
        )

    def register(self, builder: PlanBuilder) -> None:
        """Does nothing, because Gaussians are added after a frame's update."""


def _evidence(share: float) -> Evidence:
    return Evidence(share, f"regions uncovered by moving objects contain {100 * share:.0f}% of the error")


EFFECT = UncoveredEffect(
    name=NAME,
    group=EffectGroup.PRESENCE,
    description="Motion uncovers hidden background: static Gaussians are added where the state has none.",
    disambiguation="Only pixels where the state is empty count.",
    cost="a check of the last renderings; when background is uncovered, about half the time of an update",
    auto=True,
    on_above=SHARE,
    off_below=WORTH,
    committed_arrays=("share",),
)
