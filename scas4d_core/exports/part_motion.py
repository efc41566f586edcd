"""Fits the rigid motion of parts since the first frame: weighted Kabsch over the means of their Gaussians.

A Gaussian weighs as much as it covers of a picture. Where the means leave a turn open, as on a thin rod that turns
about itself, the material rotations of the Gaussians decide.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import WorldFrame
from scas4d_core.errors import InputError
from scas4d_core.gaussians import Gaussians, moving_extent, quaternions_to_matrices
from scas4d_core.query.parts import coverage

Float = NDArray[np.float64]

ROUNDS = 20
"""Of weights and fits; after about ten nothing changes."""
PRECISION = 1e-6
"""Of positions, as a share of the part's size: float32, some metres from the origin."""
PULL = 1e-9
"""Share of the points' spread that pulls towards the rotation ``near``; it decides only what the points leave open."""


@dataclass(frozen=True, eq=False)
class PartPose:
    """A part in one frame. A point x₀ of it in its own frame is at ``rotation @ x₀ + position`` in the user's world.

    The part's own frame has the user's axes and, as its origin, the weighted centre of the part in the first frame.

    Attributes:
        part: the label. rotation: [3, 3] since the first frame. position: [3] of the origin, user's units.
        residual: weighted RMS distance between the rigid prediction and the means, user's units.
    """

    part: int
    rotation: Float
    position: Float
    residual: float

    @property
    def quaternion(self) -> Float:
        """[4] (w, x, y, z), w ≥ 0."""
        return quaternion_of(self.rotation)


class PartMotion:
    """Follows parts from a first frame on; holds that frame's means, and none of the later frames.

    Gaussians that were born after the first frame or are retired in a frame do not count in it.

    Args:
        labels: [N] part of each Gaussian by row, negative for none. first: the first frame's state, in the inside
            world. world: user's world to inside.

    Attributes:
        parts: the labels that have a Gaussian in the first frame, rising.
        extent: of the moving Gaussians in the first frame, user's units; residuals are also given in percent of it.

    Raises:
        InputError: labels of another shape, or no Gaussian of the first frame belongs to a part.

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
            raise InputError("parts: no Gaussian of the first frame belongs to one", "ask for the parts of this scene")
        self.origins = {part: self._centre(self._start, self.rows(part)) for part in self.parts}
        self._first_turns = first.rotations

    def rows(self, part: int) -> NDArray[np.intp]:
        """Rows of a part that are there in the first frame."""
        return np.flatnonzero((self._labels == part) & self._present)

    def poses(self, gaussians: Gaussians) -> list[PartPose]:
        """Poses of the parts in a later frame, or in the first; a part of which no Gaussian is there has none."""
        part_poses = []
        means = self._world.to_user(gaussians.means)
        for part in self.parts:
            rows = self.rows(part)
            rows = rows[gaussians.present[rows]]
            if rows.size:
                before, weights = self._start[rows] - self.origins[part], self._weights[rows]
                material = self._mean_material_rotation(gaussians, rows, weights)
                part_poses.append(PartPose(part, *majority_motion(before, means[rows], weights, material)))
        return part_poses

    def _mean_material_rotation(self, gaussians: Gaussians, rows: NDArray[np.intp], weights: Float) -> Float:
        """[3, 3] weighted mean of the Gaussians' rotations since the first frame; about a rotation."""
        now = quaternions_to_matrices(gaussians.rotations[rows].astype(np.float64))
        then = quaternions_to_matrices(self._first_turns[rows].astype(np.float64))
        turn: Float = np.einsum("n,nik,njk->ij", weights, now, then)
        size = np.linalg.norm(turn)
        return turn * (np.sqrt(3) / size) if size > 0 else np.eye(3)

    def _centre(self, points: Float, rows: NDArray[np.intp]) -> Float:
        weights = self._weights[rows]
        return np.average(points[rows], axis=0, weights=weights if weights.sum() > 0 else None)


def majority_motion(
    before: NDArray[Any], after: NDArray[Any], weights: NDArray[Any] | None = None, near: NDArray[Any] | None = None
) -> tuple[Float, Float, float]:
    """Finds the rigid motion of most points, as ``rigid_motion`` does of all; takes and returns the same.

    Points that move otherwise count the less, the farther they are from it (Cauchy weights about the median distance,
    Holland and Welsch 1977): a part that was found from motion has Gaussians of its neighbours, and of the inside,
    which no picture holds. The distance that is left is that of all points.

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
            break  # all of it moves as one
        turn, shift, _ = rigid_motion(old, new, mass / (1 + np.square(apart / scale)), near)
    share = mass / mass.sum() if mass.sum() > 0 else np.full(len(old), 1 / max(len(old), 1))
    apart = np.square(old @ turn.T + shift - new).sum(axis=1)
    return turn, shift, float(np.sqrt(share @ apart))


def _median(values: Float, weights: Float) -> float:
    """The value below which half of the weight is."""
    order = np.argsort(values)
    sums = np.cumsum(weights[order])
    if not sums.size or not sums[-1] > 0:
        return float(np.median(values)) if values.size else 0.0
    return float(values[order][np.searchsorted(sums, sums[-1] / 2)])


def rigid_motion(
    before: NDArray[Any], after: NDArray[Any], weights: NDArray[Any] | None = None, near: NDArray[Any] | None = None
) -> tuple[Float, Float, float]:
    """Finds R and t with the least weighted sum of |R·before + t − after|² (Kabsch 1976).

    Points on a line or in one place leave a turn open; of all that fit, the one nearest to ``near`` is taken. Points in
    a plane do not: a mirror image is no rotation, and the determinant of R is +1.

    Args:
        before, after: [M, 3], M ≥ 1. weights: [M], not negative; None: all the same.
        near: [3, 3] a rotation, or about one; None: no turn.

    Returns:
        R [3, 3], t [3], and the weighted RMS distance that is left.

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
    """[4] unit quaternion (w, x, y, z), w ≥ 0, of a rotation matrix [3, 3].

    >>> quaternion_of(np.diag([1.0, -1, -1]))  # a half turn about x
    array([0., 1., 0., 0.])
    """
    quaternion: Float = np.roll(Rotation.from_matrix(rotation).as_quat(canonical=True), 1)
    return quaternion


def part_labels(labels: NDArray[Any], count: int) -> NDArray[np.int64]:
    """[count] labels: those given, cut or with −1 for Gaussians that were born later.

    >>> part_labels(np.array([0, 1]), 3)
    array([ 0,  1, -1])
    """
    given = np.asarray(labels)
    if given.ndim != 1 or not np.issubdtype(given.dtype, np.integer):
        raise InputError(
            f"parts: labels have shape {given.shape} and type {given.dtype}", "give whole numbers [N], one per Gaussian"
        )
    result = np.full(count, -1, np.int64)
    result[: len(given)] = given[:count]
    return result
