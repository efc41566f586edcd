"""Bundle adjustment of a calibrated rig on the matches of one frame, with the calibration as a prior.

The matches do not determine the position, orientation and scale of the rig. Other degrees of
freedom, such as a slight bend of a ring of cameras, are nearly undetermined. Here, a Cauchy loss
pulls each camera towards its calibrated pose. The camera thus keeps the calibrated value of every
degree of freedom that the matches do not determine, and a camera that is far off does not pull
other cameras along. pycolmap triangulates the points. The bundle adjustment of pycolmap has no such
loss, and moved the cameras of an exact rig by a median of 0.6 pixels (`robot`, 2026-11-23).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
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
MAX_STEPS = 40
"""Maximum number of Levenberg-Marquardt steps per round."""
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
    for bound in BOUNDS:
        seen, points = _triangulate_tracks(current, tracks, bound, seed)
        if len(points):
            bundle = _BundleAdjustment(cameras, seen, focal, trust)
            current = bundle.solve(current, points)
            trust = max(MIN_PRIOR_SCALE, bundle.median_prior_distance(current, points))
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
        if right.sum() >= 2:
            points.append(point)
            owner.append(who[right])
            pixels.append(uv[right])
    index = np.repeat(np.arange(len(points)), [len(who) for who in owner])
    none = np.zeros(0, np.intp)
    seen = Observations(np.concatenate([*owner, none]), index, np.concatenate([*pixels, np.zeros((0, 2))]))
    return seen, np.array(points).reshape(-1, 3)


class _BundleAdjustment:
    """Levenberg-Marquardt over poses and points, which eliminates the points (Schur complement).

    Args:
        given: calibrated cameras.
        seen: observed features.
        focal: whether to adjust focal lengths.
        trust: scale of the Cauchy loss of the calibration prior, in pixels.
    """

    def __init__(self, given: Sequence[Camera], seen: Observations, focal: bool, trust: float) -> None:
        self.given, self.seen, self.focal, self.trust = given, seen, focal, trust
        self.size = 7 if focal else 6
        self.count = len(given)

    def solve(self, cameras: list[Camera], points: Float) -> list[Camera]:
        """Returns the cameras after the last step that reduced the loss."""
        depth = self._depths(cameras, points)
        damping, loss = 1e-3, self._loss(cameras, points, depth)
        for _ in range(MAX_STEPS):
            moves, shifts = self._step(cameras, points, depth, damping)
            trial, places = [_apply_step(c, move) for c, move in zip(cameras, moves, strict=True)], points + shifts
            trial_loss = self._loss(trial, places, depth)
            if trial_loss < loss:
                gain, cameras, points, loss = (loss - trial_loss) / loss, trial, places, trial_loss
                damping = max(damping / 5, 1e-9)
                if gain < MIN_RELATIVE_GAIN:
                    break
            elif (damping := damping * 10) > 1e6:
                break
        return cameras

    def median_prior_distance(self, cameras: list[Camera], points: Float) -> float:
        """Returns the median image displacement of the adjusted cameras, in pixels.

        The displacement is the change of a camera from its calibration. Cameras without features
        are ignored.
        """
        pulls = np.linalg.norm(self._prior_residuals(cameras, self._depths(cameras, points))[0], axis=1)
        return float(np.median(pulls[np.unique(self.seen.camera)]))

    def _depths(self, cameras: Sequence[Camera], points: Float) -> Float:
        """Returns the [V] median depth of each camera's points, or 1 for cameras without points."""
        depths = np.ones(self.count)
        for index, camera in enumerate(cameras):
            own = points[self.seen.point[self.seen.camera == index]]
            if len(own):
                depths[index] = max(float(np.median(camera.to_camera(own)[:, 2])), 1e-9)
        return depths

    def _residuals(self, cameras: Sequence[Camera], points: Float) -> tuple[Float, Float, Float]:
        """Returns the reprojection errors [M, 2] and their Jacobians.

        The Jacobians are [M, 2, 6 or 7] for cameras and [M, 2, 3] for points.
        """
        seen = self.seen
        rotation = np.array([c.rotation for c in cameras])[seen.camera]
        shift = np.array([c.translation for c in cameras])[seen.camera]
        lens = np.array([(c.fx, c.fy, c.cx, c.cy) for c in cameras])[seen.camera]
        place = np.einsum("mij,mj->mi", rotation, points[seen.point]) + shift
        x, y, z = place.T
        with np.errstate(divide="ignore", invalid="ignore"):
            offset = np.stack([lens[:, 0] * x / z, lens[:, 1] * y / z], axis=1)
            by_place = np.zeros((len(z), 2, 3))
            by_place[:, 0, 0], by_place[:, 1, 1] = lens[:, 0] / z, lens[:, 1] / z
            by_place[:, :, 2] = -offset / z[:, None]
        miss = offset + lens[:, 2:] - seen.pixel
        miss[z <= 0] = np.inf  # a step that puts a point behind a camera is rejected
        columns = [by_place @ -_cross(place), by_place, *([offset[:, :, None]] if self.focal else [])]
        return miss, np.concatenate(columns, axis=2), by_place @ rotation

    def _prior_residuals(self, cameras: Sequence[Camera], depth: Float) -> tuple[Float, Float]:
        """Returns the change of each camera from its calibration, in pixels, [V, 6 or 7].

        The second result is the number of pixels per unit of each parameter, [V, 6 or 7].
        """
        rows, units = np.zeros((self.count, self.size)), np.zeros((self.count, self.size))
        for index, (before, now) in enumerate(zip(self.given, cameras, strict=True)):
            units[index, :3], units[index, 3:6] = now.fx, now.fx / depth[index]
            rows[index, :3] = Rotation.from_matrix(now.rotation @ before.rotation.T).as_rotvec()
            rows[index, 3:6] = -now.rotation @ (now.centre - before.centre)
            if self.focal:
                units[index, 6] = now.width / 4  # a typical distance from the image centre
                rows[index, 6] = np.log(now.fx / before.fx)
        return rows * units, units

    def _loss(self, cameras: Sequence[Camera], points: Float, depth: Float) -> float:
        miss = (self._residuals(cameras, points)[0] ** 2).sum(1) / NOISE**2
        pull = (self._prior_residuals(cameras, depth)[0] ** 2).sum(1) / self.trust**2
        return float(np.log1p(miss).sum() + np.log1p(pull).sum())

    def _step(self, cameras: Sequence[Camera], points: Float, depth: Float, damping: float) -> tuple[Float, Float]:
        """Returns the camera updates [V, 6 or 7] and the point updates [P, 3]."""
        seen, size, count = self.seen, self.size, len(points)
        miss, by_camera, by_point = self._residuals(cameras, points)
        weight = 1 / (1 + (miss**2).sum(1) / NOISE**2) / NOISE**2
        heavy = by_camera * weight[:, None, None]
        blocks = np.zeros((self.count, size, size))
        slope = np.zeros((self.count, size))
        np.add.at(blocks, seen.camera, np.einsum("mki,mkj->mij", heavy, by_camera))
        np.add.at(slope, seen.camera, np.einsum("mki,mk->mi", heavy, miss))
        pull, units = self._prior_residuals(cameras, depth)
        trust = (1 / (1 + (pull**2).sum(1) / self.trust**2) / self.trust**2)[:, None]
        diagonal = np.arange(size)
        blocks[:, diagonal, diagonal] += trust * units**2
        slope += trust * units * pull
        own, point_slope = np.zeros((count, 3, 3)), np.zeros((count, 3))
        np.add.at(own, seen.point, np.einsum("mki,mkj->mij", by_point * weight[:, None, None], by_point))
        np.add.at(point_slope, seen.point, np.einsum("mki,mk->mi", by_point * weight[:, None, None], miss))
        for array in (blocks, own):
            corner = np.arange(array.shape[1])
            array[:, corner, corner] *= 1 + damping
        own += np.eye(3) * 1e-12 * np.trace(own, axis1=1, axis2=2).max()
        inverse = np.linalg.inv(own)
        cross = np.einsum("mki,mkj->mij", heavy, by_point)  # [M, 6 or 7, 3]
        coupled = _sparse(cross, seen, self.count, count)
        through = _sparse(cross @ inverse[seen.point], seen, self.count, count)
        matrix = -(through @ coupled.T).toarray()
        for index in range(self.count):
            rows = slice(size * index, size * (index + 1))
            matrix[rows, rows] += blocks[index]
        right = -slope.reshape(-1) + through @ point_slope.reshape(-1)
        moves = np.linalg.solve(matrix, right)
        rest = -point_slope.reshape(-1) - coupled.T @ moves
        shifts = np.einsum("pij,pj->pi", inverse, rest.reshape(-1, 3))
        return moves.reshape(self.count, size), shifts


def _sparse(blocks: Float, seen: Observations, cameras: int, points: int) -> csr_array:
    """Assembles blocks [M, s, 3] at (camera, point) into a matrix [s · cameras, 3 · points]."""
    size = blocks.shape[1]
    rows = np.broadcast_to(size * seen.camera[:, None, None] + np.arange(size)[:, None], blocks.shape)
    columns = np.broadcast_to(3 * seen.point[:, None, None] + np.arange(3), blocks.shape)
    return csr_array((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(size * cameras, 3 * points))


def _cross(vectors: Float) -> Float:
    """Returns [M, 3, 3] cross-product matrices: [v] w = v × w."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def _apply_step(camera: Camera, move: Float) -> Camera:
    """Returns a camera after an update [6 or 7] of its parameters.

    The values are the rotation vector and the translation in camera axes, and the log of the factor
    of the focal length if there is a seventh value.
    """
    turn = Rotation.from_rotvec(move[:3]).as_matrix()
    pose, intrinsics = np.eye(4), camera.intrinsics.copy()
    pose[:3, :3], pose[:3, 3] = turn @ camera.rotation, turn @ camera.translation + move[3:6]
    if len(move) > 6:
        intrinsics[[0, 1], [0, 1]] *= np.exp(move[6])
    return Camera(camera.name, intrinsics, pose, camera.width, camera.height)
