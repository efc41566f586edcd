"""Parts: Gaussians that move alike, by K-means on positions and material rotations over time.

The paper's section "Visualization of Part Segmentation": the feature of Gaussian i is
``[λp·p_i(t), λR·R_i(t), λp0·p_i(0)]`` over the frames t. Here p is in units of the extent of what moves, so that one
set of λ serves every scene.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from sklearn.cluster import KMeans
from sklearn.metrics import silhouette_score

from scas4d_core.gaussians import Gaussians, quaternions_to_matrices
from scas4d_core.history import History, moving_extent
from scas4d_core.settings import Model

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
    restarts: int = Field(default=10, ge=1, description="Starts of K-means (n_init); the best is kept.")
    seed: int = Field(default=0, ge=0, description="Seed of the starts and of the sample.")


def parts(history: History, count: int | None = None, settings: PartsSettings | None = None) -> NDArray[np.int64]:
    """A part label for every Gaussian, [N]: 0…count−1, the largest part first; −1 for those that do not move.

    Which Gaussians move is read off the newest committed frame. A Gaussian weighs by its opacity times the area of its
    two longest axes, about what it covers in a picture, so that swarms of small ones do not draw the borders.

    Args:
        history: at least one committed frame; with a single frame only its positions tell parts apart.
        count: how many parts; None: the count from 2 to ``most_parts`` with the largest mean silhouette
            (Rousseeuw 1987) on up to 1,000 Gaussians.
        settings: λ and the clustering.

    Raises:
        ValueError: nothing committed, nothing moves, or count below 1 or above the number of moving Gaussians.
    """
    settings = settings or PartsSettings()
    if not len(history):
        raise ValueError("the history is empty; commit a frame before asking for parts")
    newest = history.gaussians(history.indices[-1])
    rows = np.flatnonzero(newest.moving)
    if rows.size == 0:
        raise ValueError("no Gaussian moves (foreground > 0.5), so there are no parts")
    if count is not None and not 1 <= count <= rows.size:
        raise ValueError(f"count {count} must be between 1 and the {rows.size} moving Gaussians")

    rng = np.random.default_rng(settings.seed)
    chosen = rows if rows.size <= settings.sample else np.sort(rng.choice(rows, settings.sample, replace=False))
    extent = moving_extent(newest)
    positions, rotations = motion(history, rows, settings.frames)
    weights = coverage(newest)
    inside = np.searchsorted(rows, chosen)
    features = part_features(positions[:, inside], rotations[:, inside], extent, settings)
    model = _cluster(features, weights[chosen], count, settings, rng)

    labels = np.empty(rows.size, dtype=np.int64)
    for start in range(0, rows.size, ROWS_AT_ONCE):
        block = slice(start, start + ROWS_AT_ONCE)
        labels[block] = model.predict(part_features(positions[:, block], rotations[:, block], extent, settings))
    size = np.bincount(labels, weights[rows], minlength=model.n_clusters)
    rank = np.empty(model.n_clusters, dtype=np.int64)
    rank[np.argsort(-size, kind="stable")] = np.arange(model.n_clusters)
    result = np.full(len(newest), STANDING, dtype=np.int64)
    result[rows] = rank[labels]
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
    features: Features, weights: NDArray[Any], count: int | None, settings: PartsSettings, rng: np.random.Generator
) -> KMeans:
    if count is None:
        # Drawn by weight, so that the silhouette sees what the pictures see.
        drawn = rng.choice(len(features), size=SILHOUETTE_SAMPLE, p=weights / weights.sum())
        count = _best_count(features[np.unique(drawn)], settings)
    return _kmeans(count, settings).fit(features, sample_weight=weights)


def _best_count(features: Features, settings: PartsSettings) -> int:
    best, best_score = 1, 0.0
    for count in range(2, min(settings.most_parts, len(features) - 1) + 1):
        labels = _kmeans(count, settings).fit_predict(features)
        score = float(silhouette_score(features, labels))
        if score > best_score:
            best, best_score = count, score
    return best


def _kmeans(count: int, settings: PartsSettings) -> KMeans:
    return KMeans(n_clusters=count, n_init=settings.restarts, random_state=settings.seed)
