"""The start of an update: the motion of the frame before goes on (paper, Optimization Pipeline).

A cluster keeps its twist in its own axes: what turns carries its displacement and its axis of rotation along, so that
a point on a circle goes on along the circle, and so do the clusters of finer layers inside it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.engine import Tables
from scas4d_core.engines.freedom import Freedom
from scas4d_core.gaussians import Gaussians, quaternion_products
from scas4d_core.structure.hierarchy import Hierarchy

Array = NDArray[np.float32]
Float = NDArray[np.float64]


WARM_START = 1.0
"""Share of the previous deformation that starts the next (paper: all of it; without, 0.6 dB are lost on `robot`)."""

LEAST_COSINE = 0.5
"""Of half the mean turn of a cluster's Gaussians, below which it says nothing."""

LONGEST_PREDICTION = 3.0
"""Times the interval it was found in that a motion is carried on for: after a longer gap it says little."""


def rotate(r: NDArray[np.floating], vectors: NDArray[np.floating]) -> Float:
    """[K, 3] vectors turned by the quaternions (1, r)/|(1, r)|, r [K, 3] = axis · tan(angle/2)."""
    cross = np.cross(r, vectors)
    turned: Float = vectors + 2 * (cross + np.cross(r, cross)) / (1 + np.square(r).sum(axis=1, keepdims=True))
    return turned


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion that an update found; the next one starts from it.

    Attributes:
        turns: per layer [K, 3] axis · tan(angle/2). shifts: per layer [K, 3] metres, relative to the layer above; both
            in the axes that the cluster has turned to.
        own_shifts: [M, 3] metres, Δp less what the finest clusters have taken of it. own_turns: [M, 3] Δr. seconds: it
            took.
    """

    turns: list[Float]
    shifts: list[Float]
    own_shifts: Float
    own_turns: Float
    seconds: float

    @property
    def finite(self) -> bool:
        """True where all of it is: else it would spoil the next start."""
        return all(np.isfinite(array).all() for array in (*self.turns, *self.shifts, self.own_shifts, self.own_turns))

    def after(self, first: Motion) -> Motion:
        """Both, one after the other in the same interval; small turns add up."""
        return replace(
            self,
            turns=[a + b for a, b in zip(first.turns, self.turns, strict=True)],
            shifts=[a + b for a, b in zip(first.shifts, self.shifts, strict=True)],
            own_shifts=first.own_shifts + self.own_shifts,
            own_turns=first.own_turns + self.own_turns,
        )

    @classmethod
    def of(cls, tables: Tables, hierarchy: Hierarchy, seconds: float) -> Motion:
        """The motion of a deformation. What the Gaussians of a finest cluster add in common becomes its own shift."""
        turns = [values[:, :3].astype(np.float64) for values in tables.clusters]
        shifts = [values[:, 3:6].astype(np.float64) for values in tables.clusters]
        rest = tables.deltas[:, :3].astype(np.float64)
        if turns:
            starts = hierarchy.starts[-1]
            common = np.add.reduceat(rest, starts[:-1]) / np.diff(starts)[:, None]
            shifts[-1] += common
            rest -= common[hierarchy.labels[-1]]
        # Into the axes that the clusters turned to, from the finest layer up: each layer turns what is below it.
        for k in reversed(range(len(turns))):
            labels = hierarchy.labels[k]
            rest = rotate(turns[k][labels], rest)
            for below in range(k + 1, len(turns)):
                parents = labels[hierarchy.starts[below][:-1]]
                turns[below] = rotate(turns[k][parents], turns[below])
                shifts[below] = rotate(turns[k][parents], shifts[below])
            shifts[k] = rotate(turns[k], shifts[k])
        return cls(turns, shifts, rest, tables.deltas[:, 3:6].astype(np.float64), seconds)


def motion_between(
    hierarchy: Hierarchy, before: Gaussians, after: Gaussians, known: NDArray[np.bool_], seconds: float
) -> Motion:
    """The motion from one state to another as a hierarchy would have found it: for one that was made in between.

    All of it is in the finest layer, whose clusters turn and shift as their known Gaussians did, in the mean.

    Args:
        before: with the first rows of ``after``. known: [M] in the order of the hierarchy; only of these Gaussians the
            motion between is known, and all have a row in ``before``; the others go on with their cluster.
        seconds: between.
    """
    layers = [np.zeros((count, 3)) for count in hierarchy.sizes]
    turns, shifts = layers, [array.copy() for array in layers]
    rows = hierarchy.rows
    rest = np.zeros((len(rows), 3))
    starts = np.where(known, rows, 0)
    there, now = before.means[starts].astype(np.float64), after.means[rows].astype(np.float64)
    if layers:
        labels, count = hierarchy.labels[-1], hierarchy.sizes[-1]
        back = before.rotations[starts] * np.array([1, -1, -1, -1], np.float32)
        turned = quaternion_products(after.rotations[rows], back).astype(np.float64)
        turned *= np.where(turned[:, :1] < 0, -1.0, 1.0)
        turn = _averages(turned, labels, known, count)
        none = turn[:, 0] < LEAST_COSINE  # no Gaussian of it is known, or they turned every way
        turn = np.where(none[:, None], 0.0, turn[:, 1:] / np.where(none, 1.0, turn[:, 0])[:, None])
        shift = rotate(turn, _averages(now - there, labels, known, count))
        # The cluster turns about the middle of all of its Gaussians, which need not be that of the known ones.
        apart = _averages(now, labels, np.ones_like(known), count) - _averages(now, labels, known, count)
        empty = np.bincount(labels, weights=known, minlength=count) == 0
        apart[empty] = 0
        turns[-1], shifts[-1] = turn, shift + rotate(turn, apart) - apart
        middle = _averages(there, labels, known, count)[labels]
        led = rotate(turn[labels], there - middle) + middle + _averages(now - there, labels, known, count)[labels]
        rest = np.where(known[:, None], rotate(turn[labels], now - led), 0.0)
    return Motion(turns, shifts, rest, np.zeros_like(rest), seconds)


def _averages(values: Float, labels: NDArray[np.int32], chosen: NDArray[np.bool_], count: int) -> Float:
    """[count, C] mean of the chosen rows of each cluster; 0 where none is."""
    own = labels[chosen]
    sums = np.stack([np.bincount(own, weights=column, minlength=count) for column in values[chosen].T], axis=1)
    means: Float = sums / np.maximum(np.bincount(own, minlength=count), 1)[:, None]
    return means


def predicted(motion: Motion | None, freedom: Freedom) -> Motion | None:
    """A motion without that which is not free in the update that it starts; None: the update starts from no motion.

    >>> motion = Motion([np.ones((1, 3))], [np.ones((1, 3))], np.ones((2, 3)), np.ones((2, 3)), 0.1)
    >>> predicted(motion, Freedom(cluster_rotation=True, prediction=True)).shifts
    [array([[0., 0., 0.]])]
    >>> predicted(motion, Freedom(cluster_rotation=True)) is None
    True
    """
    if motion is None or not freedom.prediction:
        return None
    return replace(
        motion,
        turns=motion.turns if freedom.cluster_rotation else [np.zeros_like(turns) for turns in motion.turns],
        shifts=motion.shifts if freedom.cluster_translation else [np.zeros_like(shifts) for shifts in motion.shifts],
        own_shifts=motion.own_shifts if freedom.own_position else np.zeros_like(motion.own_shifts),
        own_turns=motion.own_turns if freedom.own_rotation else np.zeros_like(motion.own_turns),
    )


def warm_start(hierarchy: Hierarchy, motion: Motion | None, seconds: float, momentum: float) -> Tables:
    """The motion before, per unit of time, as a start; scaling (c, s) and Δs start at the identity.

    Args:
        motion: of the update before; None: no motion. seconds: since it was measured.
        momentum: share of what the layers leave of it that Δp and ΔR start from.
    """
    tables = Tables.identity(hierarchy)
    if motion is None:
        return tables
    share = WARM_START * min(seconds / motion.seconds, LONGEST_PREDICTION)
    for values, turns, shifts in zip(tables.clusters, motion.turns, motion.shifts, strict=True):
        values[:, :3] = share * turns
        values[:, 3:6] = share * shifts
    tables.deltas[:, :3] = share * momentum * motion.own_shifts
    tables.deltas[:, 3:6] = share * momentum * motion.own_turns
    return tables
