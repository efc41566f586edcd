"""Builds the hierarchy of clusters of moving Gaussians (paper, Training Strategy).

K-means creates the clusters of the finest layer. Agglomerative clustering merges these clusters
into those of the coarser layers.

The Gaussians are sorted such that every cluster of every layer is a contiguous range. The kernels
and the gradient sums rely on this order.

A Gaussian with a non-finite position belongs to no cluster and does not move. The number of such
Gaussians is reported (``guards.LEFT_OUT``).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

Int = NDArray[np.int64]

KMEANS_ROUNDS = 30
"""Maximum number of Lloyd iterations. The update needs compact clusters, not optimal ones."""

KMEANS_SAMPLE_PER_CLUSTER = 256
"""Maximum number of points per cluster to which K-means is fitted. Sampling bounds time and memory."""


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """Nested clusters of the M moving Gaussians.

    Attributes:
        rows: [M] int64 row of each moving Gaussian in Θ, in an order in which all clusters are
            contiguous.
        labels: one array per layer, coarse to fine: the [M] int32 cluster index of each entry of
            ``rows``, in ascending order.
        starts: one array per layer, coarse to fine: the [K + 1] int64 boundaries of its K clusters
            in ``rows``.
        left_out: number of moving Gaussians that belong to no cluster because their positions are
            not finite.
    """

    rows: Int
    labels: tuple[NDArray[np.int32], ...]
    starts: tuple[Int, ...]
    left_out: int = 0

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of clusters in each layer, coarse to fine."""
        return tuple(len(starts) - 1 for starts in self.starts)

    @property
    def without_layers(self) -> Hierarchy:
        """Hierarchy of the same Gaussians in the same order, but without layers."""
        return Hierarchy(self.rows, (), (), self.left_out)


def build_hierarchy(
    means: NDArray[Any], moving: NDArray[np.bool_], clusters: tuple[int, ...], smallest: int, seed: int = 0
) -> Hierarchy:
    """Groups the moving Gaussians into layers of nested clusters (paper, Training Strategy).

    Args:
        means: [N, 3] positions in metres. A Gaussian with a non-finite position belongs to no
            cluster.
        moving: [N] bool mask of the Gaussians to cluster.
        clusters: number of clusters of each layer, coarse to fine, in ascending order. If empty,
            the hierarchy has no layers.
        smallest: minimum average number of Gaussians per cluster. It limits the number of clusters
            of each layer; layers that thereby become identical are merged.
        seed: random seed of K-means.

    Raises:
        ValueError: if the numbers of clusters are not strictly ascending.

    >>> points = np.array([[0, 0, 0], [5, 0, 0], [0.1, 0, 0], [5.1, 0, 0], [9, 9, 9]])
    >>> moving = np.array([True, True, True, True, False])
    >>> found = build_hierarchy(points, moving, clusters=(1, 2), smallest=1)
    >>> found.sizes
    (1, 2)
    >>> [found.rows[a:b].tolist() for a, b in pairwise(found.starts[-1])]  # the finest layer's clusters
    [[0, 2], [1, 3]]
    """
    if any(a >= b for a, b in pairwise(clusters)):
        raise ValueError(f"clusters must ascend from the coarsest to the finest layer; got {clusters}")
    finite = np.isfinite(means).all(axis=1)
    rows = np.flatnonzero(moving & finite)
    left_out = int(np.count_nonzero(moving & ~finite))
    cap = max(1, len(rows) // smallest)
    sizes = tuple(dict.fromkeys(min(size, cap) for size in clusters)) if len(rows) else ()
    if not sizes:
        return Hierarchy(rows, (), (), left_out)
    points = np.asarray(means, dtype=np.float64)[rows]
    # The rounding of sums in BLAS and OpenMP depends on the number of threads. A single thread
    # makes the clusters reproducible.
    with threadpool_limits(limits=1):
        finest = _kmeans(points, sizes[-1], seed)
        layers = [finest]
        for size in reversed(sizes[:-1]):
            layers.insert(0, _merge(points, layers[0], size))
    order = np.lexsort([rows, *reversed(layers)])
    labels, starts = [], []
    for layer in layers:
        ordered = layer[order]
        changes = np.flatnonzero(np.diff(ordered)) + 1
        begin = np.concatenate([[0], changes, [len(ordered)]]).astype(np.int64)
        labels.append(np.repeat(np.arange(len(begin) - 1, dtype=np.int32), np.diff(begin)))
        starts.append(begin)
    return Hierarchy(rows[order], tuple(labels), tuple(starts), left_out)


def _kmeans(points: NDArray[np.float64], count: int, seed: int) -> Int:
    """Returns the [M] K-means labels of points [M, 3], without empty clusters.

    The points are centred and in float64. Rounding errors differ between processors, but are then
    too small to change labels in practice.
    """
    from sklearn.cluster import KMeans  # imported here, because the import takes a second

    points = points - points.mean(axis=0)
    limit = KMEANS_SAMPLE_PER_CLUSTER * count
    rng = np.random.default_rng(seed)
    sample = points if len(points) <= limit else points[np.sort(rng.choice(len(points), limit, replace=False))]
    distinct = len(np.unique(sample, axis=0))
    model = KMeans(min(count, distinct), init="random", n_init=1, max_iter=KMEANS_ROUNDS, random_state=seed)
    model.fit(sample)
    labels: Int = model.predict(points).astype(np.int64)
    return np.unique(labels, return_inverse=True)[1]


def _merge(points: NDArray[np.float64], labels: Int, count: int) -> Int:
    """Merges clusters into ``count`` larger ones, and returns the [M] labels of the points.

    As in the paper, agglomerative clustering merges the centroids of the clusters. Its result
    initializes K-means over the centroids, which assigns each cluster to the nearest larger one.
    Without K-means, clusters that were merged early would stay together even if another assignment
    is better. Whole clusters are assigned, so the layers stay nested.
    """
    from sklearn.cluster import AgglomerativeClustering, KMeans

    present = int(labels.max()) + 1
    if count >= present:
        return labels
    counts = np.bincount(labels, minlength=present).astype(np.float64)
    centroids = _means(points, labels, present)
    merged: Int = AgglomerativeClustering(count).fit_predict(centroids).astype(np.int64)
    model = KMeans(count, init=_means(points, merged[labels], count), n_init=1, max_iter=KMEANS_ROUNDS)
    parents: Int = model.fit(centroids, sample_weight=counts).labels_.astype(np.int64)
    return np.unique(parents, return_inverse=True)[1][labels]


def _means(points: NDArray[np.float64], labels: Int, count: int) -> NDArray[np.float64]:
    """Returns the mean position [count, 3] of each cluster; no cluster may be empty."""
    sums = np.stack([np.bincount(labels, weights=points[:, k], minlength=count) for k in range(3)], axis=1)
    means: NDArray[np.float64] = sums / np.bincount(labels, minlength=count)[:, None]
    return means
