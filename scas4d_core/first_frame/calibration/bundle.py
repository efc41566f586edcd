"""Bundle adjustment of a calibrated rig on the matches of one frame, with the calibration as a prior.

The matches do not determine the position, orientation and scale of the rig. Other degrees of
freedom, such as a slight bend of a ring of cameras, are nearly undetermined. Here, a Cauchy loss
pulls each camera towards its calibrated pose. The camera thus keeps the calibrated value of every
degree of freedom that the matches do not determine, and a camera that is far off does not pull
other cameras along. pycolmap triangulates the points, and SciPy minimizes the loss. The bundle
adjustment of pycolmap has no such loss, and moved the cameras of an exact rig by a median of 0.6
pixels (`robot`, 2026-11-23).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import block_array, csr_array, eye_array, kron
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import Camera
from scas4d_core.first_frame.calibration.matches import Matches
from scas4d_core.first_frame.points.triangulation import group_by_track, triangulator
from scas4d_core.posed_pictures import Float

BOUNDS = (16.0, 6.0, 2.0)
"""Maximum reprojection error in pixels in each round. The first bound includes cameras that are far
off. The last bound excludes wrong matches."""
NOISE = 0.5
"""Scale of the Cauchy loss on reprojection errors, in pixels."""
MIN_PRIOR_SCALE = 0.5
"""Minimum scale of the Cauchy loss of the calibration prior, in pixels. Rotation, translation and
focal length are weighted by the image displacement that they cause. After the first round, the
scale is the median displacement of the rig if the displacement is larger."""
MIN_ANGLE_DEG = 1.0
"""Minimum triangulation angle in degrees. Rays at smaller angles hardly constrain depth."""
NEAREST = 1e-6
"""Minimum ratio of a point's depths in two cameras. Numerical derivatives are not finite at a camera's centre."""
MAX_STEPS = 40
"""Maximum number of evaluated steps per round."""
MIN_RELATIVE_GAIN = 1e-5
"""Relative decrease of the loss below which a round ends."""

Track = tuple[NDArray[np.intp], Float]
"""Feature track: the indices [n] of distinct cameras, and the pixel [n, 2] of the feature in each
camera."""


def build_tracks(matches: Matches) -> list[Track]:
    """Returns the tracks of matching features, except tracks with several features in the same image."""
    label, offsets = matches.tracks()
    owner = np.repeat(np.arange(len(matches.pixels)), np.diff(offsets))
    pixels = np.concatenate(matches.pixels) if len(owner) else np.zeros((0, 2))
    return [
        (owner[group], pixels[group])
        for group in group_by_track(label)
        if len(group) > 1 and len(np.unique(owner[group])) == len(group)
    ]


def bundle_adjust(
    cameras: Sequence[Camera], tracks: Sequence[Track], *, focal: bool = False, seed: int = 0
) -> list[Camera]:
    """Adjusts cameras to agree with feature tracks, and returns them in the calibrated world.

    Cameras without tracks are unchanged.

    Args:
        cameras: calibrated cameras to which the tracks refer.
        tracks: feature tracks, one per point. Some features may be wrong.
        focal: whether to adjust the focal length of each camera too. The ratio of fx to fy is
            fixed.
        seed: random seed of RANSAC.
    """
    current, trust = list(cameras), MIN_PRIOR_SCALE
    moves = np.zeros((len(cameras), 7 if focal else 6))
    for bound in BOUNDS:
        seen, points = _triangulate_tracks(current, tracks, bound, seed)
        if len(points):
            depths = _median_depths(current, seen, points)
            pixels = _pixels_per_unit(current, depths)[:, : moves.shape[1]]
            with_points = np.unique(seen.camera)
            length = float(np.median(depths[with_points]))
            moves = _adjust(cameras, moves, seen, points, pixels / trust, length)
            current = [_moved(camera, move) for camera, move in zip(cameras, moves, strict=True)]
            distances = np.linalg.norm(moves * pixels, axis=1)[with_points]
            trust = max(MIN_PRIOR_SCALE, float(np.median(distances)))
    return current


@dataclass(frozen=True, eq=False)
class Observations:
    """Observed features, with the camera index [M], point index [M] and pixel [M, 2] of each feature."""

    camera: NDArray[np.intp]
    point: NDArray[np.intp]
    pixel: Float


def _triangulate_tracks(
    cameras: Sequence[Camera], tracks: Sequence[Track], bound: float, seed: int
) -> tuple[Observations, Float]:
    """Triangulates tracks with LO-RANSAC (pycolmap).

    Returns:
        The inlier features and the points [P, 3].
    """
    point_of = triangulator(cameras, angle=MIN_ANGLE_DEG, error=bound, trials=100, seed=seed)
    points, owner, pixels = [], [], []
    for who, uv in tracks:
        answer = point_of(who, uv)
        if answer is None:
            continue
        point, right = answer
        depths = np.array([cameras[k].to_camera(point[None])[0, 2] for k in who[right]])
        if right.sum() >= 2 and depths.min() > NEAREST * depths.max():
            points.append(point)
            owner.append(who[right])
            pixels.append(uv[right])
    index = np.repeat(np.arange(len(points)), [len(who) for who in owner])
    none = np.zeros(0, np.intp)
    seen = Observations(np.concatenate([*owner, none]), index, np.concatenate([*pixels, np.zeros((0, 2))]))
    return seen, np.array(points).reshape(-1, 3)


def _median_depths(cameras: Sequence[Camera], seen: Observations, points: Float) -> Float:
    """Returns the [V] median depth of each camera's points, or 1 for cameras without points."""
    depths = np.ones(len(cameras))
    for index in np.unique(seen.camera):
        own = points[seen.point[seen.camera == index]]
        depths[index] = max(float(np.median(cameras[index].to_camera(own)[:, 2])), 1e-9)
    return depths


def _pixels_per_unit(cameras: Sequence[Camera], depths: Float) -> Float:
    """Returns the image displacement in pixels that one unit of each parameter causes, [V, 7]."""
    # The focal length is weighted at a typical distance from the image centre.
    return np.array([[c.fx] * 3 + [c.fx / depth] * 3 + [c.width / 4] for c, depth in zip(cameras, depths, strict=True)])


def _adjust(
    cameras: Sequence[Camera], moves: Float, seen: Observations, points: Float, prior: Float, length: float
) -> Float:
    """Minimizes the loss over the parameters of the cameras and the points.

    Args:
        cameras: calibrated cameras.
        moves: parameters [V, 6 or 7] to start with, as in ``_moved``.
        seen: observed features.
        points: points [P, 3] to start with.
        prior: weight of each parameter in the calibration prior, [V, 6 or 7].
        length: unit of length of the variables, so that the unit of the world does not matter.

    Returns:
        The parameters, [V, 6 or 7].
    """
    rotations = np.array([c.rotation for c in cameras])[seen.camera]
    places = np.einsum("mij,mj->mi", rotations, points[seen.point] - np.array([c.centre for c in cameras])[seen.camera])
    lenses = np.array([(c.fx, c.fy, c.cx, c.cy) for c in cameras])
    units = np.array([1, 1, 1, length, length, length, 1])[: moves.shape[1]]

    def residuals(variables: Float) -> Float:
        move, shifts = variables[: moves.size].reshape(moves.shape) * units, variables[moves.size :].reshape(-1, 3)
        turns = Rotation.from_rotvec(move[:, :3]).as_matrix()[seen.camera]
        place = places + np.einsum("mij,mj->mi", rotations, shifts[seen.point] * length)
        place = np.einsum("mij,mj->mi", turns, place) + move[seen.camera, 3:6]
        focal = lenses[:, :2] * np.exp(move[:, 6:].sum(axis=1, keepdims=True))
        with np.errstate(divide="ignore", invalid="ignore"):
            miss = focal[seen.camera] * place[:, :2] / place[:, 2:] + lenses[seen.camera, 2:] - seen.pixel
        miss[place[:, 2] <= 0] = np.inf  # a step that puts a point behind a camera is rejected
        return np.concatenate([miss.ravel() / NOISE, (move * prior).ravel()])

    # The Cauchy loss applies to the length of each feature's error and of each camera's parameters, not to each value.
    count, size = moves.shape
    features = len(seen.pixel)
    group = np.concatenate([np.repeat(np.arange(features), 2), np.repeat(features + np.arange(count), size)])
    sizes = np.bincount(group)

    def cauchy(squares: Float) -> Float:
        total = np.bincount(group, squares)
        # Without its second derivative, each step solves reweighted least squares.
        return np.stack([np.log1p(total) / sizes, 1 / (1 + total), np.zeros(len(total))])[:, group]

    by_camera = csr_array((np.ones(features), (np.arange(features), seen.camera)), shape=(features, count))
    by_point = csr_array((np.ones(features), (np.arange(features), seen.point)), shape=(features, len(points)))
    blocks: Any = [
        [kron(by_camera, np.ones((2, size))), kron(by_point, np.ones((2, 3)))],
        [eye_array(moves.size), None],
    ]
    start = np.concatenate([(moves / units).ravel(), np.zeros(points.size)])
    solution: Any = least_squares(
        residuals,
        start,
        jac_sparsity=block_array(blocks),
        x_scale="jac",
        loss=cauchy,  # type: ignore[arg-type]  # scipy-stubs 1.17 expects a second argument, which SciPy never passes
        ftol=MIN_RELATIVE_GAIN,
        max_nfev=MAX_STEPS,
    )
    adjusted: Float = solution.x[: moves.size].reshape(moves.shape) * units
    return adjusted


def _moved(camera: Camera, move: Float) -> Camera:
    """Returns a camera with changed parameters.

    ``move`` contains the rotation vector and the translation in camera axes, and the log of the factor of the focal
    length if there is a seventh value.
    """
    turn = Rotation.from_rotvec(move[:3]).as_matrix()
    pose, intrinsics = np.eye(4), camera.intrinsics.copy()
    pose[:3, :3], pose[:3, 3] = turn @ camera.rotation, turn @ camera.translation + move[3:6]
    if len(move) > 6:
        intrinsics[[0, 1], [0, 1]] *= np.exp(move[6])
    return Camera(camera.name, intrinsics, pose, camera.width, camera.height)
