"""Parts: Gaussians that move alike, by K-means on positions and material rotations over time.

The paper's section "Visualization of Part Segmentation": the feature of Gaussian i is
``[λp·p_i(t), λR·R_i(t), λp0·p_i(0)]`` over the frames t. Here p is in units of the extent of what moves, so that one
set of λ serves every scene.

Parts found again, after more frames, keep their labels: the clustering also starts from the parts before and leaves
them only for clearly better ones, and the new labels are matched to the old ones by what they cover in common.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.optimize import linear_sum_assignment
from threadpoolctl import threadpool_limits

from scas4d_core.errors import InputError
from scas4d_core.gaussians import Gaussians, moving_extent, quaternions_to_matrices
from scas4d_core.settings import Model
from scas4d_core.storage.history import History

Features = NDArray[np.float32]

STANDING = -1
"""The label of Gaussians that do not move: they belong to no part."""
SILHOUETTE_SAMPLE = 1000
"""Gaussians on which the count of parts is chosen: the silhouette takes all distances between them."""
ROWS_AT_ONCE = 8192
"""Rows whose features are held at once while every Gaussian is labelled."""


class PartsSettings(Model):
    """The features and the clustering; one set for all scenes."""

    lambda_position: float = Field(default=0.25, ge=0, description="Of p over time, p in units of the extent.")
    lambda_rotation: float = Field(
        default=1.0,
        ge=0,
        description="Of the entries of R over time; a turn of angle a moves them by 2.8 sin(a/2). Rotation tells parts "
        "apart, position only those that turn alike: with more of it long parts are cut across.",
    )
    lambda_initial: float = Field(default=0.25, ge=0, description="Of p at the first frame, repeated as in the paper.")
    frames: int = Field(
        default=32, ge=2, description="At most this many frames, evenly over the history: memory stays bounded."
    )
    sample: int = Field(
        default=20_000, ge=100, description="At most this many Gaussians are clustered; all are labelled."
    )
    most_parts: int = Field(default=12, ge=2, description="Largest count that is tried when none is given.")
    stay: float = Field(
        default=0.05,
        ge=0,
        description="Share of the inertia that a fresh clustering has to gain for the parts before to be given up.",
    )
    stay_count: float = Field(
        default=0.02,
        ge=0,
        description="Mean silhouette that another count has to gain for that of the parts before to be given up.",
    )
    restarts: int = Field(default=10, ge=1, description="Starts of K-means (n_init); the best is kept.")
    seed: int = Field(default=0, ge=0, description="Seed of the starts and of the sample.")


def parts(
    history: History,
    count: int | None = None,
    settings: PartsSettings | None = None,
    previous: NDArray[Any] | None = None,
) -> NDArray[np.int64]:
    """A part label for every Gaussian, [N]: 0…count−1, the largest part first; −1 for those that do not move.

    Which Gaussians move is read off the newest committed frame. A Gaussian weighs by its opacity times the area of its
    two longest axes, about what it covers in a picture, so that swarms of small ones do not draw the borders.

    Args:
        history: at least one committed frame; with a single frame only its positions tell parts apart.
        count: how many parts; None: the count from 2 to ``most_parts`` with the largest mean silhouette
            (Rousseeuw 1987) on up to 1,000 Gaussians.
        settings: λ and the clustering.
        previous: [N] labels found before, with the same count (or None), from fewer frames. Parts that go on keep
            their labels then, whatever their size; with a count found anew, a label may be left out.

    Raises:
        ValueError: nothing committed, nothing moves, count below 1 or above the number of moving Gaussians, or
            ``previous`` of another number of Gaussians.
    """
    settings = settings or PartsSettings()
    if not len(history):
        raise InputError("the history is empty", "commit a frame before asking for parts")
    newest = history.gaussians(history.indices[-1])
    rows = np.flatnonzero(newest.moving)
    if rows.size == 0:
        raise InputError(
            "no Gaussian moves (foreground > 0.5), so there are no parts", "ask again when something has moved"
        )
    if count is not None and not 1 <= count <= rows.size:
        raise InputError(
            f"count {count} must be between 1 and the {rows.size} moving Gaussians", "give no more than these"
        )

    if previous is not None and previous.shape != (len(newest),):
        raise InputError(f"previous labels {previous.shape} must be [{len(newest)}], one a Gaussian")

    rng = np.random.default_rng(settings.seed)
    chosen = rows if rows.size <= settings.sample else np.sort(rng.choice(rows, settings.sample, replace=False))
    extent = moving_extent(newest)
    positions, rotations = motion(history, rows, settings.frames)
    weights = coverage(newest)
    inside = np.searchsorted(rows, chosen)
    features = part_features(positions[:, inside], rotations[:, inside], extent, settings)
    before = None if previous is None else previous[chosen]
    labels = np.empty(rows.size, dtype=np.int64)
    with threadpool_limits(limits=1):  # threads would sum in another order and tip what lies between two parts
        model = _cluster(features, weights[chosen], count, settings, rng, before)
        for start in range(0, rows.size, ROWS_AT_ONCE):
            block = slice(start, start + ROWS_AT_ONCE)
            labels[block] = model.predict(part_features(positions[:, block], rotations[:, block], extent, settings))
    size = np.bincount(labels, weights[rows], minlength=model.n_clusters)
    rank = np.empty(model.n_clusters, dtype=np.int64)
    rank[np.argsort(-size, kind="stable")] = np.arange(model.n_clusters)
    result = np.full(len(newest), STANDING, dtype=np.int64)
    result[rows] = rank[labels]
    return result if previous is None else match_labels(result, previous, weights)


def match_labels(labels: NDArray[Any], previous: NDArray[Any], weights: NDArray[Any]) -> NDArray[np.int64]:
    """The same parts under the labels of those before that they overlap most, as a whole (Hungarian method).

    A part that overlaps none of those before, or whose match went to another, takes the lowest label left.

    Args:
        labels: [N] new labels from 0; negative ones belong to no part and stay.
        previous: [N] labels before.
        weights: [N] what a Gaussian counts for.

    Returns:
        [N] labels.
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
    """Positions [T, M, 3] and material rotations [T, M, 4] of some Gaussians at no more than ``frames`` even times."""
    indices = np.array(history.indices)
    even = np.unique(np.linspace(0, len(indices) - 1, min(frames, len(indices))).round().astype(np.intp))
    chosen = [int(index) for index in indices[even]]
    return history.stacked("means", chosen, rows), history.stacked("rotations", chosen, rows)


def part_features(positions: NDArray[Any], rotations: NDArray[Any], extent: float, settings: PartsSettings) -> Features:
    """The features of M Gaussians over T frames, [M, 12 T + 3] float32.

    The paper repeats p(0) at every frame; here it stands once, times √T, which leaves every distance as it was.
    All is divided by √T, so that distances do not grow with the number of frames.

    Args:
        positions: [T, M, 3] metres.
        rotations: [T, M, 4] unit quaternions.
        extent: metres.
        settings: λ.
    """
    frames, count = positions.shape[:2]
    p = positions.transpose(1, 0, 2) / extent
    turned = quaternions_to_matrices(rotations).transpose(1, 0, 2, 3)
    scale = 1 / np.sqrt(frames)
    return np.concatenate(
        [
            (settings.lambda_position * scale) * p.reshape(count, -1),
            (settings.lambda_rotation * scale) * turned.reshape(count, -1),
            settings.lambda_initial * p[:, 0],
        ],
        axis=1,
        dtype=np.float32,
    )


def coverage(gaussians: Gaussians) -> NDArray[np.float64]:
    """[N] opacity times the product of the two longest axes, m²: about what a Gaussian covers in a picture."""
    axes = np.linalg.svd(gaussians.factors.astype(np.float64), compute_uv=False)
    return gaussians.opacities * axes[:, 0] * axes[:, 1]


def _cluster(
    features: Features,
    weights: NDArray[Any],
    count: int | None,
    settings: PartsSettings,
    rng: np.random.Generator,
    previous: NDArray[Any] | None,
) -> Any:
    known = np.empty(0, np.int64) if previous is None else np.unique(previous[previous >= 0])
    if count is None:
        # Drawn by weight, so that the silhouette sees what the pictures see.
        drawn = rng.choice(len(features), size=SILHOUETTE_SAMPLE, p=weights / weights.sum())
        count = _best_count(features[np.unique(drawn)], settings, len(known))
    fresh = _kmeans(count, settings).fit(features, sample_weight=weights)
    if previous is None or len(known) != count:
        return fresh
    centres = np.stack([np.average(features[previous == k], axis=0, weights=weights[previous == k]) for k in known])
    kept = _kmeans(count, settings, init=centres, n_init=1).fit(features, sample_weight=weights)
    return kept if kept.inertia_ <= (1 + settings.stay) * fresh.inertia_ else fresh


def _best_count(features: Features, settings: PartsSettings, known: int) -> int:
    """The count of the largest mean silhouette; ``known``, that of the parts before, has an advantage (0: none)."""
    from sklearn.metrics import silhouette_score

    best, best_score = 1, 0.0
    for count in range(2, min(settings.most_parts, len(features) - 1) + 1):
        labels = _kmeans(count, settings).fit_predict(features)
        score = float(silhouette_score(features, labels)) + settings.stay_count * (count == known)
        if score > best_score:
            best, best_score = count, score
    return best


def _kmeans(count: int, settings: PartsSettings, **given: Any) -> Any:
    """scikit-learn's, whose import takes a second: whoever renders views does without."""
    from sklearn.cluster import KMeans

    return KMeans(n_clusters=count, **{"n_init": settings.restarts, "random_state": settings.seed, **given})
