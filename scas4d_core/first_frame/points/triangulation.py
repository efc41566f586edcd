"""Triangulation of SIFT features that several calibrated cameras see, using pycolmap.

Because the poses are known, matches are searched only along epipolar lines. Compared with a search
over the whole image, far fewer wrong candidates take part in the ratio test, and matches across
wide baselines are kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from scas4d_core.cameras import Camera
from scas4d_core.first_frame.time_limit import FEATURES, MATCHES, TimeLimit
from scas4d_core.posed_pictures import Bool, Float, PosedPicture, halved

RATIO = 0.8
"""Maximum ratio of best to second-best descriptor distance on the epipolar line (Lowe 2004, section 7.1)."""
MAX_DESCRIPTOR_DISTANCE = 0.7
"""Maximum distance between two matching unit descriptors, as in COLMAP."""
MAX_FEATURES = 4096
"""Maximum number of SIFT features per image. The matching time of two images is proportional to the
product of their numbers of features."""
EPIPOLAR_ERROR = 2.0
"""Maximum epipolar distance of a match and maximum reprojection error, in pixels. Calibration residuals are typically
near 0.5."""
FEW_PAIRS = 10
"""Minimum number of image pairs to match. The pace is measured on these pairs."""
FAINT_CONTRAST = 0.0017
"""SIFT contrast threshold, a quarter of the threshold of COLMAP. Features on smooth walls are
faint, and known poses reject wrong matches."""
MIN_ANGLE_DEG = 2.0
"""Minimum triangulation angle in degrees. Rays at smaller angles hardly constrain depth."""


@dataclass(frozen=True, eq=False)
class Triangulation:
    """Triangulated points and the views that see them.

    Attributes:
        positions: [P, 3] float64 point positions in the world.
        views: [P, V] bool, whether each view is an inlier of each point.
        error: [P] mean reprojection error in pixels.
    """

    positions: Float
    views: NDArray[np.bool_]
    error: Float


def extract_features(
    views: Sequence[PosedPicture],
    limit: TimeLimit | None = None,
    *,
    most: int = MAX_FEATURES,
    contrast: float = FAINT_CONTRAST,
) -> list[tuple[Float, NDArray[np.float32]]]:
    """Extracts the SIFT features of every view.

    Args:
        views: views whose images are searched.
        limit: time limit of frame 0, or None for no limit. If time is short, the images are
            downscaled by a factor of two or four.
        most: maximum number of features per image. The largest features are kept.
        contrast: minimum difference of Gaussians, for images in [0, 1].

    Returns:
        Keypoints [K, 2] (pixel centres at +0.5, as in COLMAP) and unit descriptors [K, 128] of each
        view.
    """
    import pycolmap

    options: Any = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = 1
    options.sift.max_num_features = most
    options.sift.peak_threshold = contrast
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = max(level, 1)  # otherwise COLMAP logs a line per image
    try:
        sift = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
        return _all_features(views, sift.extract_from_float32_array, limit or TimeLimit(None))
    finally:
        pycolmap.logging.minloglevel = level


def _all_features(
    views: Sequence[PosedPicture], extract: Callable[[NDArray[np.float32]], Any], limit: TimeLimit
) -> list[tuple[Float, NDArray[np.float32]]]:
    """Extracts the features of all views with a function for greyscale images.

    The pace is measured on the first view.
    """
    features_by_view: list[tuple[Float, NDArray[np.float32]]] = []
    size, began, divisor = [view.camera.width * view.camera.height for view in views], limit.clock(), 1
    for view in views:
        if len(features_by_view) == 1 and divisor == 1:
            each = (limit.clock() - began) / size[0]
            index = limit.choose(FEATURES, [each * sum(size[1:]), *(each * sum(size) / n**2 for n in (2, 4))])
            if index:
                divisor = 2 ** min(index, 2)
                limit.shortened.append(f"features extracted from images downscaled to 1/{divisor}")
                features_by_view = [_features(views[0], extract, divisor)]
        features_by_view.append(_features(view, extract, divisor))
    return features_by_view


def _features(
    view: PosedPicture, extract: Callable[[NDArray[np.float32]], Any], divisor: int
) -> tuple[Float, NDArray[np.float32]]:
    """Returns the keypoints of a view, in pixels of the full size, and the descriptors.

    Before the extraction, the image is downscaled by ``divisor``, a power of two.
    """
    image = view.image if divisor == 1 else halved(view, -(-view.camera.width // divisor)).image
    grey = image.astype(np.float32) @ np.array([0.299, 0.587, 0.114], dtype=np.float32)
    keypoints, raw = extract(np.ascontiguousarray(grey / np.float32(255)))
    descriptors = np.asarray(raw.data, dtype=np.float32).reshape(-1, 128)
    descriptors /= np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-12)
    return divisor * np.array([(point.x, point.y) for point in keypoints]).reshape(-1, 2), descriptors


def fundamental_matrix(first: Camera, second: Camera) -> Float:
    """Returns the [3, 3] matrix F with x₂ᵀ F x₁ = 0 for pixels x₁, x₂ (Hartley & Zisserman 2004, equation 9.1)."""
    rotation = second.rotation @ first.rotation.T
    x, y, z = second.translation - rotation @ first.translation
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    result: Float = np.linalg.inv(second.intrinsics).T @ cross @ rotation @ np.linalg.inv(first.intrinsics)
    return result


def guided_matches(
    first: tuple[Camera, Float, NDArray[np.float32]],
    second: tuple[Camera, Float, NDArray[np.float32]],
) -> NDArray[np.intp]:
    """Returns the mutual best matches [M, 2] between the features of two views.

    Only features within ``EPIPOLAR_ERROR`` pixels of each other's epipolar lines are compared.

    Args:
        first: camera, feature positions [A, 2] and unit descriptors [A, 128] of a view.
        second: camera, feature positions [B, 2] and unit descriptors [B, 128] of the other view.
    """
    (camera_a, uv_a, descriptors_a), (camera_b, uv_b, descriptors_b) = first, second
    if len(uv_a) == 0 or len(uv_b) == 0:
        return np.zeros((0, 2), dtype=np.intp)
    matrix = fundamental_matrix(camera_a, camera_b)
    ones_a, ones_b = np.ones((len(uv_a), 1)), np.ones((len(uv_b), 1))
    lines_b = np.hstack([uv_a, ones_a]) @ matrix.T
    lines_a = np.hstack([uv_b, ones_b]) @ matrix
    residual = np.abs(lines_b @ np.hstack([uv_b, ones_b]).T).astype(np.float32)
    slope = np.minimum(np.linalg.norm(lines_b[:, :2], axis=1)[:, None], np.linalg.norm(lines_a[:, :2], axis=1)[None, :])
    distance = descriptor_distances(descriptors_a, descriptors_b)
    distance[residual > EPIPOLAR_ERROR * slope] = 2.0
    return mutual_best(distance)


def descriptor_distances(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns the [A, B] distances between unit descriptors."""
    distances: NDArray[np.float32] = np.sqrt(np.maximum(2.0 - 2.0 * (first @ second.T), 0.0))
    return distances


def mutual_best(distance: NDArray[np.float32]) -> NDArray[np.intp]:
    """Returns the [M, 2] rows and columns of mutual nearest neighbours that pass Lowe's ratio test.

    Args:
        distance: [A, B] distances between descriptors; A and B are at least 1.

    >>> mutual_best(np.float32([[0.1, 0.6, 0.6], [0.6, 0.5, 0.51]])).tolist()  # the second row is ambiguous
    [[0, 0]]
    """
    best_b, best_a = distance.argmin(1), distance.argmin(0)
    rows = np.arange(len(distance))
    value = distance[rows, best_b]

    def runner_up(block: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.partition(block, 1, axis=1)[:, 1] if block.shape[1] > 1 else np.full(len(block), 2.0, np.float32)

    # Few features are mutual nearest neighbours, so the second-best distance is computed only for these.
    good = np.flatnonzero((best_a[best_b] == rows) & (value < MAX_DESCRIPTOR_DISTANCE))
    good = good[value[good] < RATIO * runner_up(distance[good])]
    good = good[value[good] < RATIO * runner_up(distance[:, best_b[good]].T)]
    return np.stack([rows[good], best_b[good]], axis=1)


@dataclass(frozen=True, eq=False)
class FeatureTracks:
    """SIFT features of all views, and tracks of matching features.

    Attributes:
        pixels: [F, 2] positions of all features.
        owner: [F] view index of each feature.
        groups: feature indices of each track.
    """

    pixels: Float
    owner: NDArray[np.intp]
    groups: list[NDArray[np.intp]]


def match_tracks(views: Sequence[PosedPicture], limit: TimeLimit | None = None) -> FeatureTracks:
    """Matches SIFT features over all pairs of views. Masks are ignored.

    Args:
        views: views of one frame.
        limit: time limit of frame 0, or None for no limit. If time is short, the pairs whose
            viewing directions differ most are skipped.
    """
    limit = limit or TimeLimit(None)
    features_by_view = extract_features(views, limit)
    described = [
        (view.camera, uv, descriptors) for view, (uv, descriptors) in zip(views, features_by_view, strict=True)
    ]
    offsets = np.concatenate([[0], np.cumsum([len(uv) for _, uv, _ in described])])
    owner = np.repeat(np.arange(len(views)), np.diff(offsets))
    pixels = np.concatenate([uv for _, uv, _ in described]) if len(owner) else np.zeros((0, 2))
    chosen = _affordable_pairs(described, limit)
    pairs = [guided_matches(described[a], described[b]) + offsets[[a, b]] for a, b in chosen]
    edges = np.concatenate(pairs) if pairs else np.zeros((0, 2), dtype=np.intp)
    return FeatureTracks(pixels, owner, group_by_track(label_tracks(edges, len(owner))))


def label_tracks(edges: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """Returns the track index of each of ``count`` features.

    The two features of an edge [E, 2] belong to the same track.

    >>> label_tracks(np.array([[0, 3], [3, 1]]), 4).tolist()
    [0, 0, 1, 0]
    """
    graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1])


def group_by_track(track: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Returns the feature indices of each track, in the order of track numbers.

    >>> [group.tolist() for group in group_by_track(np.array([0, 0, 1, 0]))]
    [[0, 1, 3], [2]]
    """
    order = np.argsort(track, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(track[order])) + 1) if len(order) else []


def _affordable_pairs(
    found: Sequence[tuple[Camera, Float, NDArray[np.float32]]], limit: TimeLimit
) -> list[tuple[int, int]]:
    """Returns the pairs of views that can be matched in time.

    If there is no time for all pairs, the pairs with the most similar viewing directions are
    returned.
    """
    pairs = [(a, b) for a in range(len(found)) for b in range(a + 1, len(found))]
    if not limit.bounded or len(pairs) <= FEW_PAIRS:
        return pairs
    axes = np.array([camera.rotation[2] for camera, _, _ in found])
    pairs.sort(key=lambda pair: -float(axes[pair[0]] @ axes[pair[1]]))
    work = np.array([len(found[a][1]) * len(found[b][1]) for a, b in pairs], np.float64)
    began = limit.clock()
    for a, b in pairs[:FEW_PAIRS]:
        guided_matches(found[a], found[b])
    each = (limit.clock() - began) / max(float(work[:FEW_PAIRS].sum()), 1.0)
    most = int((each * np.cumsum(work) <= limit.seconds_left(MATCHES)).sum())
    if most < len(pairs):
        most = max(most, FEW_PAIRS)
        limit.shortened.append(f"features matched in only {most} of {len(pairs)} image pairs")
    return sorted(pairs[:most])


def triangulator(
    cameras: Sequence[Camera], *, angle: float, error: float, trials: int, seed: int
) -> Callable[[NDArray[np.intp], Float], tuple[Float, Bool] | None]:
    """Returns a function that triangulates one track with fixed poses (LO-RANSAC, pycolmap).

    Args:
        cameras: calibrated cameras.
        angle: minimum triangulation angle, in degrees.
        error: maximum reprojection error, in pixels.
        trials: maximum number of RANSAC trials.
        seed: random seed of RANSAC.

    Returns:
        A function that takes camera indices [n] and pixels [n, 2], and returns the point [3] and inliers [n], or None.
    """
    import pycolmap

    lenses = [
        pycolmap.Camera(model="PINHOLE", width=c.width, height=c.height, params=[c.fx, c.fy, c.cx, c.cy])
        for c in cameras
    ]
    poses = [pycolmap.Rigid3d(pycolmap.Rotation3d(c.rotation), c.translation[:, None]) for c in cameras]
    options: Any = pycolmap.EstimateTriangulationOptions()
    options.min_tri_angle = np.deg2rad(angle)
    options.residual_type = pycolmap.TriangulationResidualType.REPROJECTION_ERROR
    options.ransac.max_error = error
    options.ransac.random_seed = seed
    options.ransac.max_num_trials = trials

    def point_of(who: NDArray[np.intp], pixels: Float) -> tuple[Float, Bool] | None:
        answer = pycolmap.estimate_triangulation(pixels, [poses[i] for i in who], [lenses[i] for i in who], options)
        if answer is None:
            return None
        right = np.asarray(answer["inlier_mask"] if "inlier_mask" in answer else answer["inliers"], dtype=bool)
        return np.asarray(answer["xyz"], dtype=np.float64).reshape(3), right

    return point_of


def triangulate(
    views: Sequence[PosedPicture], tracks: FeatureTracks | None = None, *, min_views: int = 3, seed: int = 0
) -> Triangulation:
    """Triangulates each feature track robustly (LO-RANSAC), with fixed poses.

    Args:
        views: views of one frame.
        tracks: result of ``match_tracks``, or None to compute it.
        min_views: minimum number of inlier views of a point.
        seed: random seed of RANSAC.
    """
    tracks = tracks or match_tracks(views)
    pixels, owner = tracks.pixels, tracks.owner
    point_of = triangulator(
        [view.camera for view in views], angle=MIN_ANGLE_DEG, error=EPIPOLAR_ERROR, trials=500, seed=seed
    )
    positions, seen, errors = [], [], []
    for group in tracks.groups:
        if len(np.unique(owner[group])) < min_views:
            continue
        who = owner[group]
        answer = point_of(who, pixels[group])
        if answer is None:
            continue
        point, inlier = answer
        row = np.zeros(len(views), dtype=bool)
        row[who[inlier]] = True
        if row.sum() < min_views:
            continue
        residuals = [
            np.linalg.norm(views[w].camera.project(point)[0] - uv)
            for w, uv in zip(who[inlier], pixels[group][inlier], strict=True)
        ]
        error = float(np.mean(residuals))
        if not error <= EPIPOLAR_ERROR:  # NaN if the point is behind a camera
            continue
        positions.append(point)
        seen.append(row)
        errors.append(error)
    return Triangulation(
        np.array(positions).reshape(-1, 3), np.array(seen, dtype=bool).reshape(-1, len(views)), np.array(errors)
    )
