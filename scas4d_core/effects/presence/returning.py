"""Things that come back: what was retired is shown again, as itself, where it explains something that is new."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from scas4d_core.effects.presence.carving import Hull, footprint
from scas4d_core.effects.presence.novelty import measure_novelty
from scas4d_core.gaussians import Gaussians

if TYPE_CHECKING:
    from scas4d_core.effects.presence.novelty import Novelty
    from scas4d_core.engines.renderer import Renderer

Float = NDArray[np.float64]

ALIKE = 1.5
"""Times larger or smaller, root mean square from the middle, that a hull may be than what was retired."""
EXPLAINS = 0.8
"""Of the squared error where the thing shows, that has to be gone with what was retired in its place: in a made-up room
0.85 to 1 is with the same ball, up to a small turn, and 0.6 with one of another pattern. It is rather born anew than
taken for another: an id is for ever."""
APART = 0.25
"""Of the size of a hull: retired Gaussians that are no farther apart are of one thing."""


class ReturnedThing(NamedTuple):
    """Retired Gaussians that explain a thing.

    Attributes:
        thing: number in the hull. rows: of the state. shift: [3] metres from where they were retired.
    """

    thing: int
    rows: NDArray[np.int64]
    shift: Float


def find_returned(seen: Sequence[Novelty], hull: Hull, state: Gaussians, renderer: Renderer) -> list[ReturnedThing]:
    """What of the retired explains things that are new; they are shown as they were, moved to the hull's middle.

    Args:
        seen: what the cameras say. hull: of what is new. state: Θ_t. renderer: draws.
    """
    retired = np.flatnonzero(state.retired & (state.foreground > 0.5))
    revivals: list[ReturnedThing] = []
    for thing in np.unique(hull.things):
        points = hull.points[hull.things == thing]
        best: tuple[float, ReturnedThing] | None = None
        for rows in _groups(state.means[retired].astype(np.float64), APART * _size(points)):
            own = retired[rows]
            means = state.means[own].astype(np.float64)
            taken = any(np.isin(own, one.rows).any() for one in revivals)
            if taken or not 1 / ALIKE <= _size(means) / _size(points) <= ALIKE:
                continue
            shift = points.mean(axis=0) - means.mean(axis=0)
            left = _left(
                seen, points, hull.voxel, revive_returned(state, [ReturnedThing(int(thing), own, shift)]), renderer
            )
            if left < 1 - EXPLAINS and (best is None or left < best[0]):
                best = left, ReturnedThing(int(thing), own, shift)
        if best is not None:
            revivals.append(best[1])
    return revivals


def revive_returned(state: Gaussians, found: Sequence[ReturnedThing]) -> Gaussians:
    """The state with what has returned, where it is now."""
    means = state.means.copy()
    for one in found:
        means[one.rows] += one.shift.astype(np.float32)
    rows = np.concatenate([one.rows for one in found])
    return state.replace(means=means).revive(rows)


def _size(points: Float) -> float:
    """Metres, root mean square distance from the middle."""
    return max(float(np.sqrt(np.square(points - points.mean(axis=0)).sum(axis=1).mean())), 1e-6)


def _groups(means: Float, apart: float) -> list[NDArray[np.int64]]:
    """Entries of means [R, 3] by thing: those whose cells, ``apart`` metres wide, touch."""
    if not len(means):
        return []
    cells = np.floor((means - means.min(axis=0)) / apart).astype(np.int64)
    places: list[NDArray[np.int64]] = []
    for axis in range(3):  # empty stretches between things are cut to one cell
        values = np.unique(cells[:, axis])
        steps = np.minimum(np.diff(values, prepend=values[0]), 2)
        places.append(np.cumsum(steps)[np.searchsorted(values, cells[:, axis])])
    at = tuple(places)
    grid = np.zeros([int(one.max()) + 1 for one in at], np.bool_)
    grid[at] = True
    numbers = label(grid, np.ones((3, 3, 3)))[0][at]
    return [np.flatnonzero(numbers == number) for number in np.unique(numbers)]


def _left(seen: Sequence[Novelty], points: Float, voxel: float, state: Gaussians, renderer: Renderer) -> float:
    """Share of the squared error at a thing that is left with a state."""
    before = after = 0.0
    for one in seen:
        where = one.new & footprint(one, points, voxel)
        if where.any():
            now = measure_novelty(state, state.colours, [one.view], {one.view.name: one.camera}, renderer)[0]
            before += float(one.error[where].sum())
            after += float(now.error[where].sum())
    return after / before if before > 0 else 1.0
