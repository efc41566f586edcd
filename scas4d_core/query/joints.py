"""Finds joints between parts: hinges, sliders and ball joints, with axis, centre and value in each frame.

The motion of a part relative to another is compared with each kind of joint. A joint is accepted if it explains the
relative motion up to the track noise, and if both parts meet at it. From the accepted joints, trees with the smallest
total cost are chosen (minimum spanning forest), as in Sturm, Stachniss and Burgard, "A Probabilistic Framework for
Learning Kinematic Models of Articulated Objects" (JAIR 2011).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import WorldFrame
from scas4d_core.gaussians import moving_extent
from scas4d_core.query.motion_segmentation import evenly_spaced
from scas4d_core.query.part_motion import PartTrack, part_tracks
from scas4d_core.query.parts import NO_PART
from scas4d_core.storage.history import History

Float = NDArray[np.float64]
Kind = Literal["revolute", "prismatic", "spherical"]

MOTION = 0.01
"""Smallest relative motion (RMS) that can show a joint, in units of the extent."""
ERROR, LARGEST_ERROR = 0.004, 0.01
"""RMS error of a joint that track noise explains, and the largest RMS error, both in units of the extent. Noise causes
errors of 0.0002 to 0.003."""
RELATIVE_ERROR, LARGEST_RELATIVE_ERROR = 0.05, 0.1
"""RMS error beyond ``ERROR`` that a large motion may have, and below it that a small motion may have, as shares of the
motion."""
GAP = 0.2
"""Largest distance of a joint from each of its parts, in units of the extent. An axle may be inside of a part, whose
Gaussians are on the surface."""
BALL_COST = 0.003
"""Cost of the two additional degrees of freedom of a ball joint, as an error in units of the extent."""
GAP_COST = 0.02
"""Cost of a gap, as an error per distance. Parallel hinges also explain the motion across two joints."""
FRAMES = 32
"""Maximum number of frames to which joints are fitted, evenly spaced."""
LEAST_FRAMES = 4
"""Minimum number of common frames of two parts."""
OUTLIER = 0.002
"""Error, in units of the extent, beyond which frames have less influence on the axis (soft L1 loss)."""
PULL = 1e-3
"""Weight of the prior that keeps undetermined coordinates of a centre near the child."""
SAMPLES = 61
"""Number of points on an axis whose distances to both parts are compared."""


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint between two parts over T frames, in the user's world and units. It is NaN while a part is absent.

    Attributes:
        parent, child: labels of the parts. The parent is −1 if the child is attached to something static.
        kind: ``revolute`` (hinge), ``prismatic`` (slider) or ``spherical`` (ball joint).
        axes: [T, 3] unit vectors of the axis. The axis of a ball joint changes with the child's rotation.
        centres: [T, 3] points of the axis where the parts meet, or centres of the ball.
        values: [T] angles in radians by which the child has rotated about the axis, relative to the parent, since the
            first common frame; for sliders, distances along the axis. Angles of hinges are continuous, and the first is
            between −π and π.
        error: RMS distance between the child's points and the prediction by the joint.
    """

    parent: int
    child: int
    kind: Kind
    axes: Float
    centres: Float
    values: Float
    error: float

    def rows(self, rows: Sequence[int]) -> Joint:
        """Returns the joint in some of the frames."""
        values = self.values[rows]
        if self.kind == "revolute":
            values = _continuous(values)
        return replace(self, axes=self.axes[rows], centres=self.centres[rows], values=values)


def joints(history: History, labels: NDArray[Any], world: WorldFrame, frames: Sequence[int]) -> list[Joint]:
    """Returns the joints between the parts of a scene, in some of its committed frames; see ``find_joints``.

    The joints are fitted to at most ``FRAMES`` evenly spaced frames of the whole history, so they do not depend on the
    given frames.

    Args:
        history: committed states.
        labels: [N] part label of each Gaussian, negative for none.
        world: transform from the user's world to the internal world.
        frames: T indices of committed frames in increasing order.

    Raises:
        HistoryError: if a frame was not committed.
    """
    indices = history.indices
    fitted = [indices[place] for place in evenly_spaced(len(indices), FRAMES)]
    chosen = sorted({*fitted, *frames})
    tracks = part_tracks((history.gaussians(index) for index in chosen), labels, world)
    extent = moving_extent(history.gaussians(indices[0])) / world.metres_per_unit
    fitted_rows, rows = ([chosen.index(frame) for frame in some] for some in (fitted, frames))
    return [joint.rows(rows) for joint in find_joints(tracks, extent, fitted_rows)]


def find_joints(tracks: Sequence[PartTrack], extent: float, rows: Sequence[int] | None = None) -> list[Joint]:
    """Returns the joints between parts, parents before their children.

    Args:
        tracks: motions of the parts over the same T frames. If there is one with the label −1, it contains what is
            static, and is the root of its tree. Otherwise, the root is the largest part of the tree.
        extent: extent of the moving Gaussians, in the user's units.
        rows: frames, as indices in T, to which joints are fitted; None for at most ``FRAMES`` evenly spaced ones.

    >>> leaf = np.random.default_rng(0).random((50, 3)) * [1, 2, 0.1]
    >>> opened = np.tile(np.eye(4), (5, 1, 1))
    >>> opened[:, :3, :3] = Rotation.from_rotvec(np.linspace(0, 1, 5)[:, None] * [0, 1, 0]).as_matrix()
    >>> wall = PartTrack(-1, np.tile(np.eye(4), (5, 1, 1)), np.zeros(5), leaf - [1, 0, 0], np.ones(50))
    >>> (joint,) = find_joints([wall, PartTrack(0, opened, np.zeros(5), leaf, np.ones(50))], extent=2)
    >>> joint.kind, joint.axes[0].round(3) + 0, joint.values.round(2) + 0
    ('revolute', array([0., 1., 0.]), array([0.  , 0.25, 0.5 , 0.75, 1.  ]))
    """
    tracks = [track for track in tracks if len(track.points) and np.isfinite(track.points).all()]
    if not tracks or not extent > 0:
        return []
    rows = evenly_spaced(len(tracks[0].motions), FRAMES).tolist() if rows is None else rows
    trees = [cKDTree(track.points) for track in tracks]
    best: dict[tuple[int, int], _Fit] = {}
    for one, other in permutations(range(len(tracks)), 2):
        few = _relative_motion(tracks[one], tracks[other], rows)
        if few is None or len(few.frames) < LEAST_FRAMES or not _are_close(few, trees[one], trees[other], extent):
            continue
        moved = _rms(few.errors(np.eye(3), np.zeros((1, 3)))) / extent
        if moved < MOTION:
            continue
        allowed = min(max(ERROR, RELATIVE_ERROR * moved), LARGEST_ERROR, LARGEST_RELATIVE_ERROR * moved)
        ball = _spherical(few)
        fits = [_prismatic(few), ball]
        if ball.error <= extent * allowed:  # a hinge is a special case
            fits.append(_revolute(few, OUTLIER * extent))
        for fit in fits:
            if fit.error > extent * allowed:
                continue
            fit = _at_contact(fit._replace(pair=(one, other)), few, trees[one], trees[other], extent)
            pair = min(one, other), max(one, other)
            if fit.gap <= GAP and (pair not in best or fit.cost < best[pair].cost):
                best[pair] = fit
    joints = []
    for parent, child in _directed({pair: fit.cost for pair, fit in best.items()}, tracks):
        fit = best[min(parent, child), max(parent, child)]
        joint = _joint(fit, tracks, rows, extent)
        joints.append(joint if fit.pair == (parent, child) else _reversed(joint))
    return joints


class _Relative(NamedTuple):
    """Motion of one body in the coordinates of another in F frames, since their first common frame among ``rows``.

    Attributes:
        frames: [F] common frames.
        turns, shifts: [F, 3, 3] and [F, 3] rotations R and translations t of a point x to R x + t.
        mean, spread: [3] and [3, 3] weighted mean of the moving body's points in the first common frame, and a matrix L
            with the covariance L Lᵀ.
        start: [4, 4] transform of the moving body's own points to the first common frame.
    """

    frames: NDArray[np.intp]
    turns: Float
    shifts: Float
    mean: Float
    spread: Float
    start: Float

    @property
    def means(self) -> Float:
        """[F, 3] mean of the body's points in each frame."""
        return self.turns @ self.mean + self.shifts

    def errors(self, turns: Float, shifts: Float) -> Float:
        """Returns errors [F, 12] of a predicted motion, whose sums of squares are the mean squared distances."""
        apart = self.turns - turns
        ends = apart @ self.mean + self.shifts - shifts
        return np.concatenate([(apart @ self.spread).reshape(len(apart), 9), ends], axis=1)

    def angles(self, axis: Float, centre: Float) -> Float:
        """Returns the angles [F] about an axis through a centre that predict the body's points best."""
        arm = self.mean - centre
        cross = self.turns @ (self.spread @ self.spread.T) + (self.means - centre)[:, :, None] * arm
        aligned = np.trace(cross, axis1=1, axis2=2) - np.einsum("i,tij,j->t", axis, cross, axis)
        turned = np.swapaxes(cross, 1, 2) - cross  # Σ x × y, from the antisymmetric part
        turned = np.stack([turned[:, 1, 2], turned[:, 2, 0], turned[:, 0, 1]], axis=1) @ axis
        angles: Float = np.arctan2(turned, aligned)
        return angles


class _Fit(NamedTuple):
    """The joint of one kind that fits the motion of body ``pair[1]`` relative to ``pair[0]`` best.

    Attributes:
        pair: indices of the two bodies.
        axis, centre: in the coordinates of ``pair[0]``.
        error, gap: RMS error, and distance between the joint and the farther body, in units of the extent.
    """

    kind: Kind
    axis: Float
    centre: Float
    error: float
    pair: tuple[int, int] = (0, 0)
    gap: float = 0.0

    @property
    def cost(self) -> float:
        """The error, with the costs of a gap and of a ball joint's degrees of freedom."""
        return self.error + GAP_COST * self.gap + (BALL_COST if self.kind == "spherical" else 0.0)


def _relative_motion(
    one: PartTrack, other: PartTrack, rows: Sequence[int], frames: NDArray[np.intp] | None = None
) -> _Relative | None:
    """Returns the motion of ``other`` relative to ``one``, or None if they have no common frame in ``rows``.

    Args:
        one, other: the bodies.
        rows: frames whose first common one is the reference.
        frames: frames of the result, or None for ``rows``. Only those with both bodies are used.
    """
    both = np.isfinite(one.motions[:, 0, 0]) & np.isfinite(other.motions[:, 0, 0])
    fitted = np.asarray(rows, np.intp)[both[rows]]
    if not len(fitted):
        return None
    start = np.linalg.inv(one.motions[fitted[0]]) @ other.motions[fitted[0]]
    common = fitted if frames is None else frames[both[frames]]
    motions = np.linalg.inv(one.motions[common]) @ other.motions[common] @ np.linalg.inv(start)
    points = _moved(start, other.points)
    weights = other.weights if other.weights.sum() > 0 else np.ones(len(points))
    mass = weights / weights.sum()
    mean = mass @ points
    left, sizes, _ = np.linalg.svd(((points - mean) * mass[:, None]).T @ (points - mean))
    return _Relative(common, motions[:, :3, :3], motions[:, :3, 3], mean, left * np.sqrt(sizes), start)


def _are_close(relative: _Relative, one: cKDTree, other: cKDTree, extent: float) -> bool:
    """Returns whether two bodies are close enough for a joint within ``GAP`` of both, in the first common frame."""
    points = _moved(relative.start, np.asarray(other.data, np.float64))
    return bool(np.min(one.query(points, distance_upper_bound=2 * GAP * extent)[0], initial=np.inf) < np.inf)


def _prismatic(relative: _Relative) -> _Fit:
    """Fits a slider: the body moves along an axis and does not turn."""
    moved = relative.means - relative.mean
    axis = np.linalg.svd(moved, full_matrices=False)[2][0]
    errors = relative.errors(np.eye(3), (moved @ axis)[:, None] * axis)
    return _Fit("prismatic", axis, relative.mean, _rms(errors))


def _revolute(relative: _Relative, outlier: float) -> _Fit:
    """Fits a hinge: the body turns about an axis."""
    first = np.linalg.svd(Rotation.from_matrix(relative.turns).as_rotvec(), full_matrices=False)[2][0]

    def errors(unknowns: Float) -> Float:
        axis, centre = unknowns[:3] / np.linalg.norm(unknowns[:3]), relative.mean + unknowns[3:]
        turns = Rotation.from_rotvec(relative.angles(axis, centre)[:, None] * axis).as_matrix()
        return relative.errors(turns, centre - turns @ centre)

    def with_prior(unknowns: Float) -> Float:
        # The axis has any length, and the centre any position on it.
        length, along = float(np.linalg.norm(unknowns[:3])), float(unknowns[3:] @ unknowns[:3])
        return np.append(errors(unknowns).ravel(), [length - 1, PULL * along])

    start = np.append(first, _fixed_point(relative) - relative.mean)
    found = least_squares(with_prior, start, loss="soft_l1", f_scale=max(outlier, 1e-12), max_nfev=100).x
    axis = found[:3] / np.linalg.norm(found[:3])
    return _Fit("revolute", axis, relative.mean + found[3:], _rms(errors(found)))


def _spherical(relative: _Relative) -> _Fit:
    """Fits a ball joint: the body turns about a point."""
    centre = _fixed_point(relative)
    errors = relative.errors(relative.turns, centre - relative.turns @ centre)
    return _Fit("spherical", np.full(3, np.nan), centre, _rms(errors))


def _fixed_point(relative: _Relative) -> Float:
    """Returns the point that moves least; where that leaves it open, the one nearest to the body's mean."""
    rows = np.concatenate([(np.eye(3) - relative.turns).reshape(-1, 3), PULL * np.eye(3)])
    moved = relative.means - relative.mean
    offset: Float = np.linalg.lstsq(rows, np.append(moved.ravel(), np.zeros(3)), rcond=None)[0]
    return relative.mean + offset


def _at_contact(fit: _Fit, relative: _Relative, one: cKDTree, other: cKDTree, extent: float) -> _Fit:
    """Moves the centre to the point of the axis that is nearest to both bodies, and adds the gap.

    Args:
        fit: joint with an error in the user's units.
        one, other: points of the two bodies, each in its own coordinates.
    """
    if fit.kind == "prismatic":  # the bodies meet anywhere
        places = _moved(relative.start, np.asarray(other.data, np.float64))
    elif fit.kind == "spherical":
        places = fit.centre[None]
    else:
        middle = fit.centre + fit.axis * (fit.axis @ (relative.mean - fit.centre))
        places = middle + np.linspace(-extent / 2, extent / 2, SAMPLES)[:, None] * fit.axis
    back = np.linalg.inv(relative.start)
    distances = np.maximum(np.asarray(one.query(places)[0]), other.query(_moved(back, places))[0])
    nearest = int(distances.argmin())
    return fit._replace(centre=places[nearest], error=fit.error / extent, gap=float(distances[nearest]) / extent)


def _directed(costs: dict[tuple[int, int], float], tracks: Sequence[PartTrack]) -> Iterator[tuple[int, int]]:
    """Yields the parent and child of each edge of the minimum spanning forest, from the roots to the leaves."""
    if not costs:
        return
    ends = np.array(list(costs)).T
    weights = 1 + np.array(list(costs.values()))  # SciPy treats zeros as missing edges
    forest = minimum_spanning_tree(coo_matrix((weights, ends), shape=(len(tracks), len(tracks))))
    sizes = [np.inf if track.part == NO_PART else float(track.weights.sum()) for track in tracks]
    reached: set[int] = set()
    for root in np.argsort(-np.array(sizes), kind="stable").tolist():
        if root not in reached:
            order, parents = breadth_first_order(forest, root, directed=False)
            reached.update(order.tolist())
            yield from ((int(parents[child]), int(child)) for child in order[1:])


def _joint(fit: _Fit, tracks: Sequence[PartTrack], rows: Sequence[int], extent: float) -> Joint:
    """Returns the joint in all frames, with the first body of the fit as parent."""
    one, other = (tracks[index] for index in fit.pair)
    relative = _relative_motion(one, other, rows, np.arange(len(one.motions)))
    assert relative is not None
    axes = np.broadcast_to(fit.axis, (len(relative.frames), 3))
    fitted = np.isin(relative.frames, rows)
    if fit.kind == "spherical":
        vectors = Rotation.from_matrix(relative.turns).as_rotvec()
        values = np.linalg.norm(vectors, axis=1)
        axes = np.where(values[:, None] > 0, vectors / np.maximum(values[:, None], 1e-300), np.eye(3)[0])
    else:
        hinge = fit.kind == "revolute"
        values = relative.angles(fit.axis, fit.centre) if hinge else (relative.means - relative.mean) @ fit.axis
        chosen = _continuous(values[fitted]) if hinge else values[fitted]
        if -chosen.min() > chosen.max():  # the sign of an axis is arbitrary; the largest value is positive
            axes, values = -axes, -values
        values = _continuous(values) if hinge else values
    turns = one.motions[relative.frames, :3, :3]

    def in_all_frames(rows: Float) -> Float:
        result: Float = np.full((len(one.motions), *rows.shape[1:]), np.nan)
        result[relative.frames] = rows
        return result

    return Joint(
        parent=one.part,
        child=other.part,
        kind=fit.kind,
        axes=in_all_frames(np.einsum("tij,tj->ti", turns, axes)),
        centres=in_all_frames(turns @ fit.centre + one.motions[relative.frames, :3, 3]),
        values=in_all_frames(values),
        error=fit.error * extent,
    )


def _reversed(joint: Joint) -> Joint:
    """Returns the same joint with parent and child exchanged. The parent then turns the other way about the axis."""
    return replace(joint, parent=joint.child, child=joint.parent, axes=-joint.axes)


def _continuous(angles: Float) -> Float:
    """Returns angles [T] without jumps of a whole turn between frames, skipping NaN; the first is in −π…π."""
    result = angles.copy()
    known = np.isfinite(result)
    if known.any():
        turned = np.unwrap(result[known])
        result[known] = turned - 2 * np.pi * np.round(turned[0] / (2 * np.pi))
    return result


def _moved(motion: NDArray[Any], points: NDArray[Any]) -> Float:
    """Applies a rigid transform [4, 4] to points [..., 3]."""
    moved: Float = points @ motion[:3, :3].T + motion[:3, 3]
    return moved


def _rms(errors: Float) -> float:
    """Returns the root of the mean, over frames, of the sum of squared errors [F, K]."""
    return float(np.sqrt(np.square(errors).sum(axis=1).mean()))
