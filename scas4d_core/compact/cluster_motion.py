"""Predicts a state from the previous one with one affine map per cluster of Gaussians.

As in the motion cascade of the reconstruction, a map transforms centres (x → x + A (x − c) + t) and
axes (F → (I + A) F). Material rotations are multiplied by the rotation nearest to I + A. After the
prediction, the residual of each Gaussian is small. This module requires only NumPy.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.compact.columns import Columns, multiply_rows, products
from scas4d_core.gaussians import Gaussians

Array = NDArray[np.float32]
Float = NDArray[np.float64]
Ints = NDArray[np.int64]

PER_CLUSTER, MAX_CLUSTERS = 100, 400
"""Average number of Gaussians per cluster, and maximum number of clusters.

More clusters would cost more bytes than they save (docs/format.md).
"""
ROUNDS, SAMPLE = 5, 20_000
"""Number of k-means iterations, and number of Gaussians sampled to compute the centres."""
NO_CLUSTER = 0
"""Label of Gaussians without a cluster; clusters are numbered from 1."""
SMALLEST = 1e-9
"""Lower limit on the sizes used to compute weights, in metres; prevents tiny Gaussians from dominating."""
IDENTITY = (1.0, 0.0, 0.0, 0.0)
"""The identity quaternion."""
RIDGE = 1e-3
"""Ridge regularization of A, in units of the Gaussians' size; without it, A is underdetermined in flat or thin
clusters."""


@dataclass(frozen=True, eq=False)
class Clusters:
    """Clusters of Gaussians that share an affine motion.

    Attributes:
        labels: [N] int64 label of each Gaussian: 0 if static, otherwise 1 + the cluster index.

    >>> clusters = Clusters(np.array([2, 0, 1, 2]))
    >>> clusters.count, clusters.means(np.array([[1.0, 5.0, 7.0, 3.0]]))
    (2, array([[7., 2.]]))
    """

    labels: Ints

    @cached_property
    def count(self) -> int:
        """Number of clusters."""
        return int(self.labels.max(initial=0))

    def sums(self, columns: Iterable[NDArray[Any]]) -> Float:
        """Sums each of P columns [N] over each cluster; returns [P, count]."""
        totals = [np.bincount(self.labels, column, minlength=self.count + 1)[1:] for column in columns]
        return np.array(totals, np.float64)

    @cached_property
    def sizes(self) -> Float:
        """[count] number of Gaussians in each cluster, at least 1."""
        return np.maximum(np.bincount(self.labels, minlength=self.count + 1)[1:], 1).astype(np.float64)

    def means(self, columns: NDArray[Any]) -> Float:
        """Averages the columns [P, N] over each cluster; returns [P, count]."""
        return self.sums(columns) / self.sizes

    def spread(self, values: NDArray[Any], static_value: float) -> Array:
        """Returns values per cluster [count] as values per Gaussian, [N] float32; static ones get ``static_value``."""
        table = np.empty(self.count + 1, np.float32)
        table[NO_CLUSTER], table[1:] = static_value, values
        return table[self.labels]

    def rows(self, rows: NDArray[np.intp]) -> Clusters:
        """Returns the labels of a subset of rows, which must include all moving Gaussians to preserve the clusters."""
        return Clusters(self.labels[rows])

    def concatenate(self, labels: Ints) -> Clusters:
        """Appends the labels of additional Gaussians."""
        return Clusters(np.concatenate([self.labels, labels]))

    @classmethod
    def of(cls, state: Gaussians) -> Clusters:
        """Clusters the moving Gaussians by position."""
        moving = np.flatnonzero(state.moving)
        labels = np.zeros(len(state), np.int64)
        count = min(MAX_CLUSTERS, -(-len(moving) // PER_CLUSTER))
        if count:
            labels[moving] = 1 + _k_means(state.means[moving].astype(np.float64), count)
        return cls(labels)

    def nearest(self, state: Columns, born: Columns) -> Ints:
        """Returns the labels [B] of newborn Gaussians: the nearest cluster for moving ones, otherwise 0.

        Args:
            state: existing Gaussians, to which ``labels`` apply.
            born: newborn Gaussians.
        """
        labels = np.zeros(len(born), np.int64)
        moving = np.flatnonzero(born.moving)
        if len(moving) and self.count:
            centres = self.means(state.means).T
            labels[moving] = 1 + _nearest(born.means[:, moving].T.astype(np.float64), centres)
        return labels


@dataclass(frozen=True, eq=False)
class ClusterMotion:
    """One affine map per cluster.

    Attributes:
        matrices: [K, 3, 3] matrix A of each cluster.
        shifts: [K, 3] translation t of each cluster, in metres.
    """

    matrices: Float
    shifts: Float

    @classmethod
    def fit(cls, clusters: Clusters, reference: Columns, state: Columns) -> ClusterMotion:
        """Fits the maps by least squares, weighting each Gaussian by its inverse squared size."""
        means = reference.means
        centres = clusters.means(means)
        weights = 1 / np.square(np.maximum(reference.sizes(), SMALLEST).astype(np.float64))
        arms = [mean - clusters.spread(centre, 0) for mean, centre in zip(means, centres, strict=True)]
        arms.append(np.ones(len(reference), np.float32))
        steps = state.means - means
        weighted = [weights * arm for arm in arms]
        pairs = [(i, j) for i in range(4) for j in range(i, 4)]
        moments = np.zeros((clusters.count, 4, 4))
        for (i, j), second_moments in zip(pairs, clusters.sums(weighted[i] * arms[j] for i, j in pairs), strict=True):
            moments[:, i, j] = moments[:, j, i] = second_moments
        right = clusters.sums(one * step for one in weighted for step in steps).reshape(4, 3, -1)
        # A Gaussian's weight times its squared size is 1, so each Gaussian contributes the ridge once.
        moments[:, range(3), range(3)] += RIDGE * clusters.sizes[:, None]
        moments[:, 3, 3] += 1e-12 + (moments[:, 3, 3] == 0)
        try:
            maps = np.asarray(np.linalg.solve(moments, right.transpose(2, 0, 1)), np.float64)
        except np.linalg.LinAlgError:  # values near float64 overflow; code all motion as residuals
            maps = np.zeros((clusters.count, 4, 3))
        maps[~np.isfinite(maps).all(axis=(1, 2))] = 0
        return cls(np.ascontiguousarray(maps[:, :3].transpose(0, 2, 1)), maps[:, 3])

    def predict(self, clusters: Clusters, reference: Columns) -> Columns:
        """Returns the state predicted by the maps; static Gaussians are bit-identical to the reference."""
        if not clusters.count:
            return reference
        centres = clusters.means(reference.means)
        maps = np.eye(3) + self.matrices
        spread = [[clusters.spread(maps[:, i, j], float(i == j)) for j in range(3)] for i in range(3)]
        arms = [mean - clusters.spread(centre, 0) for mean, centre in zip(reference.means, centres, strict=True)]
        ends = [clusters.spread(shift + centre, 0) for shift, centre in zip(self.shifts.T, centres, strict=True)]
        means = np.stack([arm + end for arm, end in zip(multiply_rows(spread, np.stack(arms)), ends, strict=True)])
        factors = np.stack(multiply_rows(spread, reference.factors))
        turns = polar_rotations(maps)
        own = np.stack(
            [
                clusters.spread(one, static_value)
                for one, static_value in zip(quaternions_of(turns).T, IDENTITY, strict=True)
            ]
        )
        gloss = reference.gloss
        if gloss is not None:
            count = gloss.shape[1]
            t = [[clusters.spread(turns[:, i, j], float(i == j))[:count] for j in range(3)] for i in range(3)]
            gloss = np.stack(multiply_rows(t, gloss))
        rotations = products(own, reference.rotations)
        return reference.replace(means=means, factors=factors, rotations=rotations, gloss=gloss)


def polar_rotations(matrices: Float) -> Float:
    """Returns the rotation nearest to each matrix, [K, 3, 3].

    >>> polar_rotations(np.diag([2.0, 1.0, 1.0])[None])[0].round(6)
    array([[1., 0., 0.],
           [0., 1., 0.],
           [0., 0., 1.]])
    """
    left, _, right = np.linalg.svd(matrices)
    left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
    return np.asarray(left @ right)


def quaternions_of(turns: Float) -> Float:
    """Converts rotation matrices [K, 3, 3] to unit quaternions (w, x, y, z), w ≥ 0, [K, 4] (Bar-Itzhack 2000).

    >>> quaternions_of(np.diag([-1.0, -1.0, 1.0])[None])  # a half turn about z
    array([[0., 0., 0., 1.]])
    """
    m = turns
    table = np.zeros((len(m), 4, 4))
    table[:, 0, 0] = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        table[:, 0, 1 + i] = table[:, 1 + i, 0] = m[:, k, j] - m[:, j, k]
        table[:, 1 + i, 1 + i] = m[:, i, i] - m[:, j, j] - m[:, k, k]
        table[:, 1 + j, 1 + k] = table[:, 1 + k, 1 + j] = m[:, j, k] + m[:, k, j]
    vectors = np.linalg.eigh(table)[1][:, :, 3]
    first = np.argmax(np.abs(vectors) > 1e-9, axis=1)
    signs = np.sign(vectors[np.arange(len(m)), first])[:, None]
    return np.asarray(vectors * signs) + 0.0


def _k_means(points: Float, count: int) -> Ints:
    """Returns the cluster index of each point, [N]; the result is deterministic."""
    draw = np.random.default_rng(0)
    sample = points if len(points) <= SAMPLE else points[draw.choice(len(points), SAMPLE, replace=False)]
    centres = sample[draw.choice(len(sample), count, replace=False)]
    for _ in range(ROUNDS):
        nearest = _nearest(sample, centres)
        members = np.bincount(nearest, minlength=count)
        sums = np.stack([np.bincount(nearest, sample[:, axis], minlength=count) for axis in range(3)], axis=1)
        centres = np.where(members[:, None] > 0, sums / np.maximum(members, 1)[:, None], centres)
    labels = _nearest(points, centres)
    return np.unique(labels, return_inverse=True)[1].astype(np.int64)  # drop empty clusters


def _nearest(points: Float, centres: Float, piece: int = 512) -> Ints:
    """Returns the index of each point's nearest centre, [N]. Processing in cache-sized blocks is 10× faster."""
    squares = np.square(centres).sum(axis=1)
    nearest = [
        np.argmin(squares - 2 * points[begin : begin + piece] @ centres.T, axis=1)
        for begin in range(0, len(points), piece)
    ]
    return np.concatenate(nearest).astype(np.int64)
