"""Part segmentation: groups Gaussians by motion.

With a given number of parts, this is K-means on positions and material rotations over time, as in the section
"Visualization of Part Segmentation" of the paper. The feature of Gaussian i is ``[λp·p_i(t), λR·R_i(t), λp0·p_i(0)]``
over the frames t. Here, p is in units of the extent of the moving Gaussians, so the same λ values suit every scene.
Otherwise, ``motion_segmentation`` determines the number of parts and the parts.

When parts are computed again after more frames, they keep their labels. The clustering also starts from the previous
parts, and replaces them only if a fresh clustering is clearly better. New labels are matched to previous ones by their
overlap.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from threadpoolctl import threadpool_limits

from scas4d_core.errors import InputError
from scas4d_core.gaussians import Gaussians, moving_extent, quaternion_products, quaternions_to_matrices
from scas4d_core.query import motion_segmentation
from scas4d_core.storage.births import NO_PARENT
from scas4d_core.storage.history import History

Features = NDArray[np.float32]

NO_PART = -1
"""Label of static Gaussians, which belong to no part."""
ROWS_AT_ONCE = 8192
"""Number of Gaussians labelled at a time, to limit the memory for features."""

LAMBDA_POSITION = 0.25
"""λp, the weight of p over time, with p in units of the extent."""
LAMBDA_ROTATION = 1.0
"""λR, the weight of the entries of R over time, which a rotation by angle a changes by 2.8 sin(a/2). Rotations separate
most parts, whereas positions separate only parts that rotate alike. A larger position weight would split long parts."""
LAMBDA_INITIAL = 0.25
"""λp0, the weight of p in the first frame, which the paper repeats in every frame."""
MAX_FRAMES = 32
"""Maximum number of frames in the features, evenly spaced over the history. The limit bounds memory use."""
SAMPLE = 20_000
"""Maximum number of Gaussians used for clustering. All moving Gaussians are labelled afterwards."""
MERGING_SAMPLE = 6_000
"""Maximum number of Gaussians from which the number of parts is determined."""
STAY = 0.05
"""Previous parts are kept unless their inertia exceeds that of a fresh clustering by more than this fraction."""
RESTARTS = 10
"""Number of K-means initializations (n_init); the best result is kept."""
SEED = 0
"""Random seed of the initializations and the sample."""


def parts(
    history: History,
    count: int | None = None,
    previous: NDArray[Any] | None = None,
) -> NDArray[np.int64]:
    """Returns the part label of each Gaussian, [N] int64: 0…count−1, largest part first; −1 for static Gaussians.

    The newest committed frame determines which Gaussians move. Each Gaussian is weighted by its approximate image area
    (``coverage``), so many small Gaussians do not dominate.

    Args:
        history: history with at least one committed frame. With a single frame, only positions separate parts.
        count: number of parts. If None, parts are separate if their relative motion exceeds the track noise and the
            deformation within them (``motion_segmentation``). Parts that do not move are labelled −1, unless nothing
            moves: then all Gaussians form one part. Retired Gaussians are labelled, too.
        previous: [N] labels computed from fewer frames with the same ``count``, or None. Parts that persist then keep
            their labels, regardless of size. If the number of parts is chosen again, labels may have gaps.

    Raises:
        ValueError: if no frame is committed, no Gaussian moves, ``count`` is not between 1 and the number of moving
            Gaussians, or ``previous`` has the wrong shape.

    >>> from scas4d_core.storage.history import History
    >>> boxes = np.random.default_rng(0).random((40, 3))
    >>> boxes[20:] += [3, 0, 0]
    >>> state = Gaussians.of_points(boxes, radius=0.1)
    >>> apart = np.repeat([[0, 0, 0], [2, 0, 0]], 20, axis=0)
    >>> history = History()
    >>> for index in range(3):  # the second box moves away
    ...     history.append(index, index / 30, state.replace(means=state.means + np.float32(index * apart)))
    >>> labels = parts(history, count=2)
    >>> len(set(labels[:20])), len(set(labels[20:])), bool(labels[0] != labels[20])
    (1, 1, True)
    """
    if not len(history):
        raise InputError("the history is empty", "commit a frame before requesting parts")
    newest = history.gaussians(history.indices[-1])
    rows = np.flatnonzero(newest.moving)
    if rows.size == 0:
        raise InputError(
            "no Gaussian moves (foreground > 0.5), so there are no parts", "try again after something has moved"
        )
    if count is not None and not 1 <= count <= rows.size:
        raise InputError(
            f"count {count} is not between 1 and {rows.size}, the number of moving Gaussians",
            "use a count in this range",
        )

    if previous is not None and previous.shape != (len(newest),):
        raise InputError(f"previous labels must have shape [{len(newest)}], one per Gaussian; got {previous.shape}")

    weights = coverage(newest)
    if count is None:
        rows = np.flatnonzero(newest.foreground > 0.5)  # retired Gaussians belong to parts of earlier frames
        weights[rows] = _last_coverage(history, rows, weights[rows])
        labels = _separated(history, rows, weights[rows], None if previous is None else previous[rows])
    else:
        labels = _clustered(history, rows, weights[rows], count, None if previous is None else previous[rows])
    found, labels[labels >= 0] = np.unique(labels[labels >= 0], return_inverse=True)
    size = np.bincount(labels[labels >= 0], weights[rows][labels >= 0], minlength=len(found))
    rank = np.empty(len(found), dtype=np.int64)
    rank[np.argsort(-size, kind="stable")] = np.arange(len(found))
    result = np.full(len(newest), NO_PART, dtype=np.int64)
    result[rows] = np.where(labels >= 0, rank[labels], NO_PART)
    return result if previous is None else match_labels(result, previous, weights)


def _separated(
    history: History, rows: NDArray[np.intp], weights: NDArray[Any], previous: NDArray[Any] | None
) -> NDArray[np.int64]:
    """Returns the part of each of M rows [M], with as many parts as their motion shows."""
    frames = motion_segmentation.FRAMES
    positions, rotations = motion(history, rows, frames)
    present = _presence(history, rows, _evenly(history, frames))
    weights = weights * present.mean(axis=0)
    sample = None
    if rows.size > MERGING_SAMPLE:
        sample = np.sort(np.random.default_rng(SEED).choice(rows.size, MERGING_SAMPLE, replace=False))
    with threadpool_limits(limits=1):  # threads would change the summation order and flip Gaussians between two parts
        labels = motion_segmentation.segment_motion(positions, rotations, present, weights, previous, sample)
    return labels if (labels >= 0).any() else np.zeros_like(labels)


def _last_coverage(history: History, rows: NDArray[np.intp], newest: NDArray[Any]) -> NDArray[np.float64]:
    """Returns the coverage of M rows in the newest frame, or while they were present if they are retired, [M]."""
    result, indices = newest.copy(), _evenly(history, motion_segmentation.FRAMES)
    for index in indices[::-1]:
        gone = (result <= 0) & history.present(index)[rows]
        if gone.any():
            result[gone] = coverage(history.gaussians(index).rows(rows[gone]))
    return result


def _clustered(
    history: History, rows: NDArray[np.intp], weights: NDArray[Any], count: int, previous: NDArray[Any] | None
) -> NDArray[np.int64]:
    """Returns the K-means cluster of each of M rows [M]."""
    rng = np.random.default_rng(SEED)
    inside = np.arange(rows.size) if rows.size <= SAMPLE else np.sort(rng.choice(rows.size, SAMPLE, replace=False))
    extent = moving_extent(history.newest)
    positions, rotations = motion(history, rows, MAX_FRAMES)
    features = part_features(positions[:, inside], rotations[:, inside], extent)
    labels = np.empty(rows.size, dtype=np.int64)
    with threadpool_limits(limits=1):  # threads would change the summation order and flip Gaussians between two parts
        model = _cluster(features, weights[inside], count, None if previous is None else previous[inside])
        for start in range(0, rows.size, ROWS_AT_ONCE):
            block = slice(start, start + ROWS_AT_ONCE)
            labels[block] = model.predict(part_features(positions[:, block], rotations[:, block], extent))
    return labels


def match_labels(labels: NDArray[Any], previous: NDArray[Any], weights: NDArray[Any]) -> NDArray[np.int64]:
    """Renumbers parts to maximize their overlap with the previous labels (Hungarian method).

    A part that overlaps no previous part, or whose match was assigned to another part, receives the lowest free label.

    Args:
        labels: [N] new labels from 0; negative labels belong to no part and are unchanged.
        previous: [N] previous labels.
        weights: [N] weight of each Gaussian.

    Returns:
        The renumbered labels, [N].

    >>> previous = np.array([0, 0, 1, 1])
    >>> match_labels(np.array([1, 1, 0, 0]), previous, weights=np.ones(4))  # the same parts with different numbers
    array([0, 0, 1, 1])
    """
    result = labels.astype(np.int64)
    inside = labels >= 0
    both = inside & (previous >= 0)
    count = int(labels.max(initial=-1)) + 1
    overlap = np.zeros((count, int(previous.max(initial=-1)) + 1))
    np.add.at(overlap, (labels[both], previous[both]), weights[both])
    names = np.full(count, -1, dtype=np.int64)
    for new, old in zip(*linear_sum_assignment(overlap, maximize=True), strict=True):
        if overlap[new, old] > 0:
            names[new] = old
    free = (label for label in range(count + overlap.shape[1]) if label not in set(names.tolist()))
    for new in np.flatnonzero(names < 0):
        names[new] = next(free)
    result[inside] = names[labels[inside]]
    return result


def motion(history: History, rows: NDArray[np.intp], frames: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Returns positions [T, M, 3] and material rotations [T, M, 4] of Gaussians over time.

    At most ``frames`` evenly spaced frames are used. Before its birth, a Gaussian is assumed to move with its
    parent, or to be static if it has no parent.
    """
    chosen = _evenly(history, frames)
    positions, rotations = history.stacked("means", chosen, rows), history.stacked("rotations", chosen, rows)
    unborn = np.isnan(positions[..., 0]) & (history.born_at[rows] > np.array(chosen)[:, None])
    late = np.flatnonzero(unborn.any(axis=0))
    if len(late):
        before_birth = _before_birth(history, rows[late], chosen)
        for array, earlier in zip((positions, rotations), before_birth, strict=True):
            array[:, late] = np.where(unborn[:, late, None], earlier, array[:, late])
    return positions, rotations


def _evenly(history: History, frames: int) -> list[int]:
    """Returns the indices of at most ``frames`` evenly spaced frames."""
    indices = np.array(history.indices)
    return [int(index) for index in indices[motion_segmentation.evenly_spaced(len(indices), frames)]]


def _presence(history: History, rows: NDArray[np.intp], indices: list[int]) -> NDArray[np.bool_]:
    """Returns whether each of M Gaussians, or before its birth an ancestor, is present in T frames, [T, M]."""
    parents = history.parents
    present = np.zeros((len(indices), rows.size), bool)
    for row, index in enumerate(indices):
        ancestors = rows.copy()
        while (up := (history.born_at[ancestors] > index) & (parents[ancestors] != NO_PARENT)).any():
            ancestors = np.where(up, parents[ancestors], ancestors)
        present[row] = history.present(index)[ancestors]
    return present


def _before_birth(history: History, rows: NDArray[np.intp], indices: list[int]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Returns positions [T, M, 3] and rotations [T, M, 4] of Gaussians as if they moved with their ancestors."""
    roots, parents, ancestors = history.roots(), history.parents, rows.copy()
    while (up := parents[ancestors] != NO_PARENT).any():
        ancestors = np.where(up, parents[ancestors], ancestors)
    leads, turned = history.stacked("means", indices, ancestors), history.stacked("rotations", indices, ancestors)
    positions = np.broadcast_to(roots.means[rows], leads.shape).copy()
    rotations = np.broadcast_to(roots.rotations[rows], turned.shape).copy()
    led = np.isfinite(leads[..., 0])
    which = np.nonzero(led)[1]
    back = roots.rotations[ancestors] * np.array([1, -1, -1, -1], np.float32)
    turns = quaternion_products(turned[led], back[which])
    offsets = roots.means[rows] - roots.means[ancestors]
    positions[led] = leads[led] + np.einsum("nij,nj->ni", quaternions_to_matrices(turns), offsets[which])
    rotations[led] = quaternion_products(turns, roots.rotations[rows][which])
    return positions, rotations


def part_features(positions: NDArray[Any], rotations: NDArray[Any], extent: float) -> Features:
    """Returns the features of M Gaussians over T frames, [M, 12 T + 3] float32.

    The paper repeats p(0) in every frame. Here, p(0) is included once, scaled by √T, so the distances are the same. All
    features are divided by √T, because distances would otherwise grow with the number of frames.

    Args:
        positions: [T, M, 3] positions in metres.
        rotations: [T, M, 4] material rotations as unit quaternions.
        extent: extent of the moving Gaussians, in metres.
    """
    frames, count = positions.shape[:2]
    p = positions.transpose(1, 0, 2) / extent
    turned = quaternions_to_matrices(rotations).transpose(1, 0, 2, 3)
    scale = 1 / np.sqrt(frames)
    return np.concatenate(
        [
            (LAMBDA_POSITION * scale) * p.reshape(count, -1),
            (LAMBDA_ROTATION * scale) * turned.reshape(count, -1),
            LAMBDA_INITIAL * p[:, 0],
        ],
        axis=1,
        dtype=np.float32,
    )


def coverage(gaussians: Gaussians) -> NDArray[np.float64]:
    """Returns each Gaussian's approximate image area in m², [N]: opacity times the product of its two longest axes."""
    axes = np.linalg.svd(gaussians.factors.astype(np.float64), compute_uv=False)
    return gaussians.opacities * axes[:, 0] * axes[:, 1]


def _cluster(features: Features, weights: NDArray[Any], count: int, previous: NDArray[Any] | None) -> Any:
    known = np.empty(0, np.int64) if previous is None else np.unique(previous[previous >= 0])
    fresh = _kmeans(count).fit(features, sample_weight=weights)
    if previous is None or len(known) != count:
        return fresh
    centres = np.stack([np.average(features[previous == k], axis=0, weights=weights[previous == k]) for k in known])
    kept = _kmeans(count, init=centres, n_init=1).fit(features, sample_weight=weights)
    return kept if kept.inertia_ <= (1 + STAY) * fresh.inertia_ else fresh


def _kmeans(count: int, **given: Any) -> Any:
    """Returns a scikit-learn K-means model. The import takes a second, so it is deferred until a model is needed."""
    from sklearn.cluster import KMeans

    return KMeans(n_clusters=count, **{"n_init": RESTARTS, "random_state": SEED, **given})
