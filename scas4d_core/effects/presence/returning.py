"""Returning objects: retired Gaussians are revived with their ids if they explain a new object."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from scas4d_core.effects.presence.carving import Hull, footprint, without_gaps
from scas4d_core.effects.presence.novelty import measure_novelty
from scas4d_core.gaussians import Gaussians

if TYPE_CHECKING:
    from scas4d_core.effects.presence.novelty import Novelty
    from scas4d_core.engines.renderer import Renderer

Float = NDArray[np.float64]

ALIKE = 1.5
"""Maximum ratio between the RMS sizes of a hull and of the retired Gaussians."""
EXPLAINS = 0.8
"""Minimum share of the squared error at an object that the revived Gaussians must remove. In a synthetic room, the same
ball removes 0.85 to 1 if it has hardly rotated, and a ball with another pattern removes 0.6. When in doubt, new
Gaussians are added instead, because a wrong id would be permanent."""
APART = 0.25
"""Distance, relative to the hull's size, up to which retired Gaussians belong to the same object."""


class ReturnedThing(NamedTuple):
    """Retired Gaussians that explain a new object.

    Attributes:
        thing: object number in the hull.
        rows: rows of the Gaussians in the state.
        shift: [3] displacement from the position at which they were retired, in metres.
    """

    thing: int
    rows: NDArray[np.int64]
    shift: Float


def find_returned(seen: Sequence[Novelty], hull: Hull, state: Gaussians, renderer: Renderer) -> list[ReturnedThing]:
    """Returns the retired Gaussians that explain new objects when they are moved to the centre of the hull.

    Args:
        seen: novelty map of each camera.
        hull: hull of the new objects.
        state: state Θ_t, including the retired Gaussians.
        renderer: renderer for the state.
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
    """Returns the state with the returned objects revived at their new positions."""
    means = state.means.copy()
    for one in found:
        means[one.rows] += one.shift.astype(np.float32)
    rows = np.concatenate([one.rows for one in found])
    return state.replace(means=means).revive(rows)


def _size(points: Float) -> float:
    """Returns the RMS distance of points from their centre, in metres."""
    return max(float(np.sqrt(np.square(points - points.mean(axis=0)).sum(axis=1).mean())), 1e-6)


def _groups(means: Float, apart: float) -> list[NDArray[np.int64]]:
    """Groups means [R, 3] into objects whose cells of ``apart`` metres touch, and returns the indices of each group."""
    if not len(means):
        return []
    cells = np.floor((means - means.min(axis=0)) / apart).astype(np.int64)
    at = tuple(without_gaps(column) for column in cells.T)
    grid = np.zeros([int(one.max()) + 1 for one in at], np.bool_)
    grid[at] = True
    numbers = label(grid, np.ones((3, 3, 3)))[0][at]
    return [np.flatnonzero(numbers == number) for number in np.unique(numbers)]


def _left(seen: Sequence[Novelty], points: Float, voxel: float, state: Gaussians, renderer: Renderer) -> float:
    """Returns the share of the squared error in an object's new pixels that remains when a state is rendered."""
    before = after = 0.0
    for one in seen:
        where = one.new & footprint(one, points, voxel)
        if where.any():
            now = measure_novelty(state, state.colours, [one.view], {one.view.name: one.camera}, renderer)[0]
            before += float(one.error[where].sum())
            after += float(now.error[where].sum())
    return after / before if before > 0 else 1.0
