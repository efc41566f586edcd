"""Start of an update from matches between a rendering of the extrapolated state and the images.

Gradients of the image loss reach only as far as the structures in an image. If a part is farther than that from where
it was expected, an update may converge to a wrong motion. Patches of small images are therefore matched over larger
distances, and the coarsest clusters start from the rigid motions that agree with the matches of several cameras.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.engine import Tables
from scas4d_core.engines.renderer import Renderer
from scas4d_core.engines.views import LABEL, TrainingView
from scas4d_core.gaussians import Gaussians, moving_extent, quaternion_products
from scas4d_core.kernels.patch_matches import LEVELS, fit_clusters, match_patches
from scas4d_core.structure.hierarchy import Hierarchy
from scas4d_core.update.best_state import spread_cameras
from scas4d_core.update.view_factory import ViewFactory
from scas4d_core.update.warm_start import rotate

Array = NDArray[np.float32]
Float = NDArray[np.float64]

VIEWS = 6
"""Number of cameras, spread over the rig, in whose images patches are matched."""
FAR = 1.3
"""Ratio between the error of the extrapolated state and the usual error of updates from which patches are matched."""
GAIN = 0.05
"""Smallest relative decrease of the error on the probe views with which an update starts from matches."""
DAMPING = 0.02
"""Levenberg–Marquardt damping of a cluster's motion, relative to the matches of all its points in one camera."""
SMALLEST_PX = 1.0
"""RMS motion of a cluster, in pixels of the small images, below which it starts where it is expected."""
POINTS = 24
"""Number of points per cluster of the coarsest layer. Finer clusters would have too few matches."""
SIDE = 120
"""Shorter side of the small images in pixels, at least, unless images are smaller; at most twice as many."""
SMALLEST_SIDE = 96
"""Shorter side below which images are not matched. With 64 pixels, matches moved the result by up to −1.8 dB."""
TOLERANCE = 0.02
"""Depth behind the rendered surface up to which a point is visible, in units of the extent."""
COVERED = 0.5
"""Opacity above which a rendered pixel has a depth."""


def matched_start(
    tables: Tables,
    previous: Gaussians,
    state: Gaussians,
    hierarchy: Hierarchy,
    views: Sequence[TrainingView],
    factory: ViewFactory,
    renderer: Renderer,
) -> Tables | None:
    """Returns a deformation in which the coarsest clusters follow the matches, or None if none of them moves.

    Args:
        tables: deformation from which the update would start.
        previous: previous state Θ_{t−1}.
        state: previous state, deformed by ``tables``.
        hierarchy: hierarchy of the moving Gaussians.
        views: views of the frame.
        factory: factory of the views.
        renderer: renderer for the state.
    """
    views = [view for view in views if min(view.camera.width, view.camera.height) >= SMALLEST_SIDE]
    if not hierarchy.sizes or not views:
        return None
    sample, starts = _sample(hierarchy)
    points = state.means[hierarchy.rows[sample]].astype(np.float64)
    normal, right, weight = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3)), np.zeros(len(points))
    names = spread_cameras(factory.rig, [view.name for view in views], VIEWS)
    small = [_small(factory, view) for view in views if view.name in names]
    tolerance = TOLERANCE * moving_extent(state)
    pictures = renderer.render_each([(state, view.camera) for view in small], depth_channel=LABEL)
    for view, picture in zip(small, pictures, strict=True):
        alpha = 1 - picture.transmittance
        depth = np.full(alpha.shape, np.inf, np.float32)
        np.divide(picture.features[LABEL], alpha, out=depth, where=alpha > COVERED)
        source, firsts, sizes = _pyramid(view.exposed(picture.features[:3]))
        target = _pyramid(view.target[:3])[0]
        pose, lens = view.camera.pose.astype(np.float64), view.camera.lens.astype(np.float64)
        match_patches(
            source, target, depth.ravel(), firsts, sizes, pose, lens, tolerance, points, normal, right, weight
        )
    turns, before, after = (np.empty((hierarchy.sizes[0], 3)) for _ in range(3))
    fit_clusters(points, normal, right, weight, starts, DAMPING, SMALLEST_PX, turns, before, after)
    if not (before != after).any():
        return None
    return _followed_by(tables, previous, hierarchy, turns, before, after)


def _followed_by(
    tables: Tables, previous: Gaussians, hierarchy: Hierarchy, turns: Float, before: Float, after: Float
) -> Tables:
    """Returns a deformation followed by a rigid motion of each cluster of the coarsest layer.

    Args:
        tables: the deformation of ``previous``.
        previous: previous state Θ_{t−1}.
        hierarchy: hierarchy of the moving Gaussians.
        turns: [K, 3] rotations Q, as axis · tan(angle/2).
        before, after: [K, 3] points such that a position x moves to Q (x − before) + after.
    """
    result = tables.copy()
    first = hierarchy.starts[0]
    coarsest = result.clusters[0]
    means = previous.means[hierarchy.rows].astype(np.float64)
    pivots = np.add.reduceat(means, first[:-1]) / np.diff(first)[:, None] + coarsest[:, 3:6]
    coarsest[:, 3:6] += rotate(turns, pivots - before) + after - pivots
    coarsest[:, :3] = _composed(turns, coarsest[:, :3].astype(np.float64))
    # Finer layers, and the Gaussians' own motion, rotate with their coarsest cluster.
    for table, starts in zip(result.clusters[1:], hierarchy.starts[1:], strict=True):
        parents = hierarchy.labels[0][starts[:-1]]
        for columns in (slice(0, 3), slice(3, 6)):
            table[:, columns] = rotate(turns[parents], table[:, columns].astype(np.float64))
    result.deltas[:, :3] = rotate(turns[hierarchy.labels[0]], result.deltas[:, :3].astype(np.float64))
    return result


def _sample(hierarchy: Hierarchy) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Returns entries [N] of the hierarchy's rows, and the boundaries [K + 1] of the coarsest clusters in them."""
    first, sizes = hierarchy.starts[0][:-1], np.diff(hierarchy.starts[0])
    counts = np.minimum(sizes, POINTS)
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    step = np.arange(starts[-1]) - np.repeat(starts[:-1], counts)
    return np.repeat(first, counts) + step * np.repeat(sizes, counts) // np.repeat(counts, counts), starts


def _composed(turns: Float, first: Float) -> Float:
    """Returns rotations [K, 3] as axis · tan(angle/2), of ``turns`` after ``first``."""
    one, other = (np.concatenate([np.ones((len(each), 1)), each], axis=1) for each in (turns, first))
    products = quaternion_products(one, other)
    safe = np.where(np.abs(products[:, :1]) < 1e-3, 1e-3, products[:, :1])
    composed: Float = products[:, 1:] / safe
    return composed


def _small(factory: ViewFactory, view: TrainingView) -> TrainingView:
    """Returns the view at a size whose shorter side has ``SIDE`` to twice as many pixels, or a small view unchanged."""
    scale = 1.0
    while min(view.camera.width, view.camera.height) >= 2 * SIDE:  # halving is fast
        scale *= 0.5
        view = factory.coarser(view, scale)
    return view


def _pyramid(colours: Array) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
    """Returns the levels of the mean of colours [3, H, W], one after the other, with starts [L] and sizes [L, 2]."""
    levels = [(colours[0] + colours[1] + colours[2]) / np.float32(3)]
    while len(levels) < LEVELS:
        height, width = levels[-1].shape
        even = levels[-1][: height // 2 * 2, : width // 2 * 2]
        levels.append(0.25 * (even[0::2, 0::2] + even[1::2, 0::2] + even[0::2, 1::2] + even[1::2, 1::2]))
    sizes = np.array([level.shape[::-1] for level in levels], np.int64)
    starts = np.concatenate([[0], np.cumsum(sizes.prod(axis=1))[:-1]]).astype(np.int64)
    return np.concatenate([level.ravel() for level in levels]), starts, sizes
