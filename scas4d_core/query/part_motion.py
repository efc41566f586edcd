"""Fits the rigid motion of each part since the first frame with the weighted Kabsch algorithm.

The fitted points are the means of the part's Gaussians, weighted by image coverage. If the means
leave a rotation undetermined, such as that of a thin rod about its axis, the Gaussians' material
rotations determine the rotation.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import WorldFrame
from scas4d_core.errors import InputError
from scas4d_core.gaussians import Gaussians, moving_extent, quaternions_to_matrices
from scas4d_core.query.parts import NO_PART, coverage

Float = NDArray[np.float64]

ROUNDS = 20
"""Maximum number of reweighting iterations; results stop changing after about ten."""
PRECISION = 1e-6
"""Precision of float32 positions a few metres from the origin, relative to the part's size."""
STARTED = 0.3
"""Share of a part's Gaussians that its first frame contains. Gaussians of one part may be born in different frames."""
PULL = 1e-9
"""Weight of the prior rotation ``near`` relative to the points' spread; it matters only if R is ambiguous."""


@dataclass(frozen=True, eq=False)
class PartPose:
    """The pose of a part in one frame, which maps a local point x₀ to ``rotation @ x₀ + position``.

    The result is in the user's world. Local coordinates have the user's axes. The local origin is
    the weighted centre of the part in the first frame.

    Attributes:
        part: label of the part.
        rotation: [3, 3] rotation since the first frame.
        position: [3] position of the local origin, in the user's units.
        residual: weighted RMS distance between the rigid prediction and the means, in the user's units.
        origin: [3] local origin in the first frame, in the user's world.
    """

    part: int
    rotation: Float
    position: Float
    residual: float
    origin: Float

    @property
    def motion(self) -> Float:
        """[4, 4] transform of the part's points from the first frame, in the user's world."""
        transform = np.eye(4)
        transform[:3, :3] = self.rotation
        transform[:3, 3] = self.position - self.rotation @ self.origin
        return transform

    @property
    def quaternion(self) -> Float:
        """[4] quaternion (w, x, y, z) of the rotation, w ≥ 0."""
        return quaternion_of(self.rotation)


class PartMotion:
    """The rigid motion of parts relative to a first frame.

    Only the first frame is stored. Gaussians that were born after the first frame, or that are
    retired in the given frame, are ignored.

    Args:
        labels: [N] part label of each Gaussian, negative for none.
        first: state of the first frame in the internal world.
        world: transform from the user's world to the internal world.

    Attributes:
        parts: labels with at least one Gaussian in the first frame, in increasing order.
        extent: extent of the moving Gaussians in the first frame, in the user's units; the reference for percentages.
        origins: local origin [3] of each part in the user's world, keyed by label.

    Raises:
        InputError: if the labels have an invalid shape or type, or no Gaussian of the first frame belongs to a part.

    >>> state = Gaussians.of_points([[0, 0, 2], [1, 0, 2], [0, 1, 2]], radius=0.1)
    >>> motion = PartMotion(np.zeros(3, int), state, WorldFrame(np.zeros(3), metres_per_unit=0.5))
    >>> (pose,) = motion.poses(state.replace(means=state.means + np.float32([0, 0, 1])))
    >>> (pose.position - motion.origins[0]).round(6) + 0, round(pose.residual, 6)
    (array([0., 0., 2.]), 0.0)
    """

    def __init__(self, labels: NDArray[Any], first: Gaussians, world: WorldFrame) -> None:
        self._labels = part_labels(labels, len(first))
        self._world = world
        self._present = first.present
        self._start = world.to_user(first.means)
        self._weights = np.maximum(coverage(first), 0)
        self.extent = moving_extent(first) / world.metres_per_unit
        self.parts = sorted({int(part) for part in self._labels[first.present] if part >= 0})
        if not self.parts:
            raise InputError("parts: no Gaussian of the first frame belongs to a part", "use the parts of this scene")
        self.origins = {part: self._centre(self._start, self.rows(part)) for part in self.parts}
        self._first_turns = first.rotations

    def rows(self, part: int) -> NDArray[np.intp]:
        """Returns the rows of a part that are present in the first frame."""
        return np.flatnonzero((self._labels == part) & self._present)

    def points(self, part: int) -> tuple[Float, Float]:
        """Returns the means [M, 3] and weights [M] of a part's Gaussians in the first frame, in the user's world."""
        rows = self.rows(part)
        return self._start[rows], self._weights[rows]

    def poses(self, gaussians: Gaussians) -> list[PartPose]:
        """Returns the poses of the parts in the first or a later frame; parts without present Gaussians are omitted."""
        part_poses = []
        means = self._world.to_user(gaussians.means)
        for part in self.parts:
            rows = self.rows(part)
            rows = rows[gaussians.present[rows]]
            if rows.size:
                before, weights = self._start[rows] - self.origins[part], self._weights[rows]
                material = self._mean_material_rotation(gaussians, rows, weights)
                part_poses.append(
                    PartPose(part, *majority_motion(before, means[rows], weights, material), self.origins[part])
                )
        return part_poses

    def _mean_material_rotation(self, gaussians: Gaussians, rows: NDArray[np.intp], weights: Float) -> Float:
        """Returns the weighted mean [3, 3] of material rotations since the first frame, which is nearly a rotation."""
        now = quaternions_to_matrices(gaussians.rotations[rows].astype(np.float64))
        then = quaternions_to_matrices(self._first_turns[rows].astype(np.float64))
        turn: Float = np.einsum("n,nik,njk->ij", weights, now, then)
        size = np.linalg.norm(turn)
        return turn * (np.sqrt(3) / size) if size > 0 else np.eye(3)

    def _centre(self, points: Float, rows: NDArray[np.intp]) -> Float:
        weights = self._weights[rows]
        return np.average(points[rows], axis=0, weights=weights if weights.sum() > 0 else None)


@dataclass(frozen=True, eq=False)
class PartTrack:
    """Rigid motion of one part over T frames, in the user's world and units.

    Attributes:
        part: label of the part.
        motions: [T, 4, 4] transforms of the part's points from its first frame to each frame; NaN while it is absent.
        residuals: [T] weighted RMS distance between the rigid prediction and the means; NaN while the part is absent.
        points: [M, 3] means of the part's Gaussians in its first frame.
        weights: [M] weights of these Gaussians (image coverage).
    """

    part: int
    motions: Float
    residuals: Float
    points: Float
    weights: Float


def part_tracks(states: Iterable[Gaussians], labels: NDArray[Any], world: WorldFrame) -> list[PartTrack]:
    """Returns the rigid motion of each part over T states, ordered by label.

    The first frame of a part is the first one that contains at least the share ``STARTED`` of its Gaussians. Parts
    without such a frame are omitted. If there are Gaussians without a part, they form a track with the label −1 and the
    identity as motion.

    Args:
        states: T states in the internal world, in the order of time. Only one is in memory at a time.
        labels: [N] part label of each Gaussian, negative for none.
        world: transform from the user's world to the internal world.

    >>> state = Gaussians.of_points([[0, 0, 2], [1, 0, 2], [0, 1, 2]], radius=0.1)
    >>> states = [state, state.replace(means=state.means + np.float32([0, 0, 1]))]
    >>> (track,) = part_tracks(states, np.zeros(3, int), WorldFrame(np.zeros(3)))
    >>> track.motions[1, :3, 3].round(6) + 0
    array([0., 0., 1.])
    """
    waiting = {part: int(np.count_nonzero(labels == part)) for part in np.unique(labels[labels >= 0]).tolist()}
    started: list[PartMotion] = []  # one for all parts with the same first frame
    poses: dict[int, dict[int, PartPose]] = {part: {} for part in waiting}
    first: Gaussians | None = None
    count = 0
    for index, state in enumerate(states):
        count = index + 1
        first = state if first is None else first
        present = part_labels(labels, len(state))[state.present]
        new = [part for part, size in waiting.items() if np.count_nonzero(present == part) >= STARTED * size]
        if new:
            waiting = {part: size for part, size in waiting.items() if part not in new}
            started.append(PartMotion(np.where(np.isin(labels, new), labels, NO_PART), state, world))
        for motion in started:
            for pose in motion.poses(state):
                poses[pose.part][index] = pose
    tracks = [] if first is None else [still_track(first, labels, world, count)]
    for motion in started:
        for part in motion.parts:
            motions, residuals = np.full((count, 4, 4), np.nan), np.full(count, np.nan)
            for index, pose in poses[part].items():
                motions[index], residuals[index] = pose.motion, pose.residual
            tracks.append(PartTrack(part, motions, residuals, *motion.points(part)))
    return sorted((track for track in tracks if len(track.points)), key=lambda track: track.part)


def still_track(first: Gaussians, labels: NDArray[Any], world: WorldFrame, frames: int) -> PartTrack:
    """Returns the track of the Gaussians of a state that belong to no part and do not move, with the label −1.

    Args:
        first: state in the internal world.
        labels: [N] part label of each Gaussian, negative for none.
        world: transform from the user's world to the internal world.
        frames: number of frames.
    """
    rows = np.flatnonzero(first.present & (part_labels(labels, len(first)) < 0))
    points, weights = world.to_user(first.means[rows]), np.maximum(coverage(first.rows(rows)), 0)
    return PartTrack(NO_PART, np.tile(np.eye(4), (frames, 1, 1)), np.zeros(frames), points, weights)


def majority_motion(
    before: NDArray[Any], after: NDArray[Any], weights: NDArray[Any] | None = None, near: NDArray[Any] | None = None
) -> tuple[Float, Float, float]:
    """Fits the rigid motion of most points; arguments and results are those of ``rigid_motion``.

    Cauchy weights, scaled by the median distance, suppress outliers (Holland and Welsch 1977). A
    part that was segmented by motion has outliers: Gaussians of neighbouring parts, and interior
    Gaussians that no image constrains. The returned RMS distance is over all points.

    >>> before = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [2, 2, 2]])
    >>> shift = majority_motion(before, before + np.where(np.arange(6)[:, None] < 5, [0, 0, 1], [5, 0, 0]))[1]
    >>> shift.round(3) + 0
    array([0., 0., 1.])
    """
    old, new = np.asarray(before, np.float64), np.asarray(after, np.float64)
    mass = np.ones(len(old)) if weights is None else np.asarray(weights, np.float64)
    turn, shift, _ = rigid_motion(old, new, mass, near)
    size = float(np.ptp(old, axis=0).max(initial=0))
    for _ in range(ROUNDS):
        apart = np.linalg.norm(old @ turn.T + shift - new, axis=1)
        scale = max(_median(apart, mass), PRECISION * size)
        if scale <= 0 or (len(old) and apart.max() <= PRECISION * size):
            break  # all points already fit
        turn, shift, _ = rigid_motion(old, new, mass / (1 + np.square(apart / scale)), near)
    share = mass / mass.sum() if mass.sum() > 0 else np.full(len(old), 1 / max(len(old), 1))
    apart = np.square(old @ turn.T + shift - new).sum(axis=1)
    return turn, shift, float(np.sqrt(share @ apart))


def _median(values: Float, weights: Float) -> float:
    """Returns the weighted median."""
    order = np.argsort(values)
    sums = np.cumsum(weights[order])
    if not sums.size or not sums[-1] > 0:
        return float(np.median(values)) if values.size else 0.0
    return float(values[order][np.searchsorted(sums, sums[-1] / 2)])


def rigid_motion(
    before: NDArray[Any], after: NDArray[Any], weights: NDArray[Any] | None = None, near: NDArray[Any] | None = None
) -> tuple[Float, Float, float]:
    """Finds R and t that minimize the weighted sum of |R·before + t − after|² (Kabsch 1976).

    Collinear or coincident points leave R ambiguous; the solution nearest to ``near`` is returned. Coplanar points
    determine R, because reflections are excluded (det R = +1).

    Args:
        before, after: [M, 3] corresponding points, M ≥ 1.
        weights: [M] nonnegative weights, or None for equal weights.
        near: [3, 3] exact or approximate prior rotation, or None for the identity.

    Returns:
        R [3, 3], t [3], and the weighted RMS residual.

    >>> before = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0]])
    >>> quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    >>> turn, shift, left = rigid_motion(before, before @ quarter.T + [5, 0, 0])
    >>> bool(np.allclose(turn, quarter)), shift.round(6) + 0, round(left, 6)
    (True, array([5., 0., 0.]), 0.0)
    """
    old, new = np.asarray(before, np.float64), np.asarray(after, np.float64)
    mass = np.ones(len(old)) if weights is None else np.asarray(weights, np.float64)
    if not mass.sum() > 0:
        mass = np.ones(len(old))
    mass = mass / mass.sum()
    centre, target = mass @ old, mass @ new
    spread = ((new - target) * mass[:, None]).T @ (old - centre)
    prior = np.eye(3) if near is None else np.asarray(near, np.float64)
    size = np.linalg.norm(spread)
    left, _, right = np.linalg.svd(spread + (PULL * size if size > 0 else 1.0) * prior)
    handed = np.array([1.0, 1.0, np.linalg.det(left @ right)])
    turn: Float = (left * handed) @ right
    shift: Float = target - turn @ centre
    apart = np.square(old @ turn.T + shift - new).sum(axis=1)
    return turn, shift, float(np.sqrt(mass @ apart))


def quaternion_of(rotation: NDArray[Any]) -> Float:
    """Converts a rotation matrix [3, 3] to a unit quaternion [4] (w, x, y, z), w ≥ 0.

    >>> quaternion_of(np.diag([1.0, -1, -1]))  # a half turn about x
    array([0., 1., 0., 0.])
    """
    quaternion: Float = np.roll(Rotation.from_matrix(rotation).as_quat(canonical=True), 1)
    return quaternion


def part_labels(labels: NDArray[Any], count: int) -> NDArray[np.int64]:
    """Truncates labels to ``count`` entries, or pads them with −1 for Gaussians that were born later.

    Raises:
        InputError: if the labels are not an integer array of shape [N].

    >>> part_labels(np.array([0, 1]), 3)
    array([ 0,  1, -1])
    """
    given = np.asarray(labels)
    if given.ndim != 1 or not np.issubdtype(given.dtype, np.integer):
        raise InputError(
            f"parts: labels have shape {given.shape} and type {given.dtype}",
            "use an integer array of shape [N], one label per Gaussian",
        )
    result = np.full(count, -1, np.int64)
    result[: len(given)] = given[:count]
    return result
