"""Warm start of an update, which extrapolates the motion of the previous frame (paper, Optimization Pipeline).

A cluster keeps its twist in its own axes, so its displacement and rotation axis rotate with it. A cluster that moves on
a circle thus continues along the circle, and so do the finer clusters inside it.
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
"""Share of the previous deformation from which an update starts (paper: 1; with 0, `robot` loses 0.6 dB)."""

LEAST_COSINE = 0.5
"""Minimum cosine of half the mean rotation angle of a cluster's Gaussians for a reliable mean."""

LONGEST_PREDICTION = 3.0
"""Maximum extrapolation of a motion, in multiples of the interval in which it was found."""


def rotate(r: Float, vectors: Float) -> Float:
    """Returns vectors [K, 3] rotated by the quaternions (1, r)/|(1, r)|, with r [K, 3] = axis · tan(angle/2)."""
    with np.errstate(over="ignore", invalid="ignore"):  # an update may diverge; see ``Motion.finite``
        cross = np.cross(r, vectors)
        scale = 1 + np.square(r).sum(axis=1, keepdims=True)
        rotated: Float = vectors + 2 * (cross + np.cross(r, cross)) / scale
    return rotated


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion that an update found, from which the next one starts.

    Attributes:
        turns: [K, 3] rotations of the clusters in each layer: axis · tan(angle/2), in the rotated axes of the cluster.
        shifts: [K, 3] translations of the clusters in each layer relative to the layer above, in metres in the rotated
            axes of the cluster.
        own_shifts: [M, 3] displacements Δp minus the part that belongs to the finest clusters, in metres. Empty if
            no update starts from the Gaussians' own motion.
        own_turns: [M, 3] rotations ΔR of the Gaussians, or empty; see ``Tables.deltas``.
        seconds: duration of the motion, in seconds.
    """

    turns: list[Float]
    shifts: list[Float]
    own_shifts: Float
    own_turns: Float
    seconds: float

    @property
    def finite(self) -> bool:
        """Whether all values are finite. Otherwise, no update can start from the motion."""
        return all(np.isfinite(array).all() for array in (*self.turns, *self.shifts, self.own_shifts, self.own_turns))

    def after(self, first: Motion) -> Motion:
        """Returns this motion composed with ``first`` within the same interval. Small rotations are added."""
        return replace(
            self,
            turns=[a + b for a, b in zip(first.turns, self.turns, strict=True)],
            shifts=[a + b for a, b in zip(first.shifts, self.shifts, strict=True)],
            own_shifts=first.own_shifts + self.own_shifts,
            own_turns=first.own_turns + self.own_turns,
        )

    @classmethod
    def of(cls, tables: Tables, hierarchy: Hierarchy, seconds: float, *, own: bool = True) -> Motion:
        """Returns the motion of a deformation. The mean Δp of a cluster in the finest layer is added to its shift.

        If ``own`` is false, the motion of individual Gaussians is left out.
        """
        turns = [values[:, :3].astype(np.float64) for values in tables.clusters]
        shifts = [values[:, 3:6].astype(np.float64) for values in tables.clusters]
        rest = tables.deltas[:, :3].astype(np.float64)
        if turns:
            starts = hierarchy.starts[-1]
            common = np.add.reduceat(rest, starts[:-1]) / np.diff(starts)[:, None]
            shifts[-1] += common
            rest -= common[hierarchy.labels[-1]]
        own_turns = tables.deltas[:, 3:6].astype(np.float64)
        if not own:
            rest, own_turns = np.empty((0, 3)), np.empty((0, 3))
        # Rotate into the clusters' rotated axes, from the finest layer up: each layer rotates those below it.
        for k in reversed(range(len(turns))):
            labels = hierarchy.labels[k]
            if own:
                rest = rotate(turns[k][labels], rest)
            for below in range(k + 1, len(turns)):
                parents = labels[hierarchy.starts[below][:-1]]
                turns[below] = rotate(turns[k][parents], turns[below])
                shifts[below] = rotate(turns[k][parents], shifts[below])
            shifts[k] = rotate(turns[k], shifts[k])
        return cls(turns, shifts, rest, own_turns, seconds)


def motion_between(
    hierarchy: Hierarchy, before: Gaussians, after: Gaussians, known: NDArray[np.bool_], seconds: float
) -> Motion:
    """Returns the motion between two states for a hierarchy that was built in between.

    The motion is entirely in the finest layer, whose clusters rotate and translate like the mean of their known
    Gaussians.

    Args:
        hierarchy: hierarchy of the moving Gaussians in ``after``.
        before: first state; its rows are the first rows of ``after``.
        after: second state.
        known: [M] mask, in hierarchy order, of Gaussians whose motion is known. These have a row in ``before``. The
            others follow their cluster.
        seconds: time between the states, in seconds.
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
        none = turn[:, 0] < LEAST_COSINE  # no known Gaussian, or their rotations disagree
        turn = np.where(none[:, None], 0.0, turn[:, 1:] / np.where(none, 1.0, turn[:, 0])[:, None])
        shift = rotate(turn, _averages(now - there, labels, known, count))
        # The cluster rotates about the centroid of all its Gaussians, which may differ from that of the known ones.
        apart = _averages(now, labels, np.ones_like(known), count) - _averages(now, labels, known, count)
        empty = np.bincount(labels, weights=known, minlength=count) == 0
        apart[empty] = 0
        turns[-1], shifts[-1] = turn, shift + rotate(turn, apart) - apart
        middle = _averages(there, labels, known, count)[labels]
        led = rotate(turn[labels], there - middle) + middle + _averages(now - there, labels, known, count)[labels]
        rest = np.where(known[:, None], rotate(turn[labels], now - led), 0.0)
    return Motion(turns, shifts, rest, np.zeros_like(rest), seconds)


def _averages(values: Float, labels: NDArray[np.int32], chosen: NDArray[np.bool_], count: int) -> Float:
    """Returns the [count, C] mean of the chosen rows of each cluster, or 0 for a cluster without chosen rows."""
    own = labels[chosen]
    sums = np.stack([np.bincount(own, weights=column, minlength=count) for column in values[chosen].T], axis=1)
    means: Float = sums / np.maximum(np.bincount(own, minlength=count), 1)[:, None]
    return means


def predicted(motion: Motion | None, freedom: Freedom) -> Motion | None:
    """Returns the motion without the parameters that are not free in the next update, or None if there is none.

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
    """Returns the initial deformation from the previous motion. Scaling (c, s) and Δs start at the identity.

    Args:
        hierarchy: hierarchy of the moving Gaussians.
        motion: motion of the previous update, or None for no motion.
        seconds: time since that motion was measured, in seconds.
        momentum: share of the Gaussians' own motion, relative to the layers, from which Δp and ΔR start.
    """
    tables = Tables.identity(hierarchy)
    if motion is None:
        return tables
    share = WARM_START * min(seconds / motion.seconds, LONGEST_PREDICTION)
    for values, turns, shifts in zip(tables.clusters, motion.turns, motion.shifts, strict=True):
        values[:, :3] = share * turns
        values[:, 3:6] = share * shifts
    if momentum > 0 and len(motion.own_shifts):
        tables.deltas[:, :3] = share * momentum * motion.own_shifts
        tables.deltas[:, 3:6] = share * momentum * motion.own_turns
    return tables
