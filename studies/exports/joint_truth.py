"""Comparison of the joints between parts with the true poses of a capture.

The true joints are those that ``find_joints`` finds in the true points and poses, where a joint's error is 0. A joint
of the reconstruction is between the true parts that most of the points of its two parts belong to.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from client.cli.scores import Column, markdown
from client.importers.open_source import open_source
from scas4d_core.captures.ground_truth import GroundTruth, TruePart
from scas4d_core.gaussians import moving_extent
from scas4d_core.query.joints import Joint, find_joints, joints
from scas4d_core.query.part_motion import PartTrack, part_tracks
from scas4d_core.query.parts import NO_PART, parts
from scas4d_core.settings import Settings
from scas4d_core.storage.history import History

Float = NDArray[np.float64]


@dataclass(frozen=True)
class JointFigures:
    """Errors of one joint.

    Attributes:
        between: names of the true parts, or of one part if both belong to it.
        kind: kind of the joint.
        true: whether the true parts have a joint, and the centre is on it: within 1% of the extent.
        drift: RMS distance between the places where the two true parts carry the centre, in percent of the extent.
        axis: angle between the axis and the true one in degrees, or None if there is no axis.
        angle: RMS error of the angles in degrees, or None.
    """

    between: tuple[str, ...]
    kind: str
    true: bool
    drift: float
    axis: float | None = None
    angle: float | None = None


def measure_joints(folder: Path, states: Path) -> tuple[list[JointFigures], int]:
    """Returns the figures of the joints of a reconstruction, and the number of true joints.

    Args:
        folder: capture folder with ground truth.
        states: folder that contains the capture's committed states.
    """
    capture = open_source(folder)
    truth = capture.ground_truth
    if truth is None:
        return [], 0
    history = History.load(states)
    world = capture.full_rig.world_frame(Settings().scene.metres_per_unit)
    labels = parts(history)
    found = joints(history, labels, world, history.indices)
    tracks = part_tracks((history.gaussians(index) for index in history.indices), labels, world)
    extent = moving_extent(history.gaussians(history.indices[0])) / world.metres_per_unit
    owners = {track.part: _owner(track, truth) for track in tracks}
    rigid = {part.id: part for part in truth.parts if part.pose is not None}
    true = find_joints([_true_track(part, truth, history.indices) for part in rigid.values()], extent)
    figures = []
    for joint in found:
        one, other = owners[joint.parent], owners[joint.child]
        if one in rigid and other in rigid:
            between = {_label(rigid[one]), _label(rigid[other])}
            known = any(between == {each.parent, each.child} for each in true)
            figures.append(compare_joint(joint, rigid[one], rigid[other], known, history.indices, extent))
    return figures, len(true)


COLUMNS = (
    Column("between", "between"),
    Column("kind", "kind"),
    Column("true", "true"),
    Column("drift of the centre, %", "drift"),
    Column("axis, °", "axis"),
    Column("angle, RMS, °", "angle"),
)


def report(figures: list[JointFigures], count: int) -> str:
    """Formats the figures as a Markdown table, with the number of true joints found."""
    found = len({frozenset(one.between) for one in figures if one.true})
    rows = [vars(one) | {"between": ", ".join(one.between), "true": "yes" if one.true else "no"} for one in figures]
    return f"{found} of {count} true joints; {len(figures)} joints between rigid parts.\n\n{markdown(rows, COLUMNS)}"


def _owner(track: PartTrack, truth: GroundTruth) -> int:
    """Returns the id of the true part that most of a track's points are nearest to, in the track's first frame."""
    first = int(np.flatnonzero(np.isfinite(track.motions[:, 0, 0]))[0])
    nearest = cKDTree(truth.points[first]).query(track.points)[1]
    return int(np.bincount(truth.part_id[nearest], track.weights).argmax())


def _true_track(part: TruePart, truth: GroundTruth, frames: list[int]) -> PartTrack:
    assert part.pose is not None
    points = truth.points[frames[0], truth.part_id == part.id]
    motions = part.pose[frames] @ np.linalg.inv(part.pose[frames[0]])
    return PartTrack(_label(part), motions, np.zeros(len(frames)), points, np.ones(len(points)))


def _label(part: TruePart) -> int:
    return NO_PART if part.static else part.id


def compare_joint(
    joint: Joint, one: TruePart, other: TruePart, known: bool, frames: list[int], extent: float
) -> JointFigures:
    """Compares a joint with the true motion of two parts."""
    there = np.flatnonzero(np.isfinite(joint.values))
    assert one.pose is not None
    assert other.pose is not None
    parent, child = (pose[np.array(frames)[there]] for pose in (one.pose, other.pose))
    motions = np.linalg.inv(parent) @ child @ np.linalg.inv(child[0]) @ parent[0]
    to_parent = np.linalg.inv(parent[0])
    centre = to_parent @ np.append(joint.centres[there[0]], 1)
    drift = 100 * float(np.sqrt(np.square((motions @ centre - centre)[:, :3]).sum(axis=1).mean())) / extent
    names = (one.name,) if one is other else (one.name, other.name)
    figures = JointFigures(names, joint.kind, known and drift <= 1, drift)
    if joint.kind != "revolute" or not known:
        return figures
    axis = to_parent[:3, :3] @ joint.axes[there[0]]
    true_axis = np.linalg.svd(Rotation.from_matrix(motions[:, :3, :3]).as_rotvec(), full_matrices=False)[2][0]
    true_axis = true_axis * np.sign(true_axis @ axis)
    turns = Rotation.from_matrix(motions[:, :3, :3]).as_rotvec() @ true_axis
    apart = np.angle(np.exp(1j * (turns - joint.values[there])))
    degrees = float(np.degrees(np.arccos(min(1.0, float(true_axis @ axis)))))
    return JointFigures(
        names, joint.kind, figures.true, drift, degrees, float(np.degrees(np.sqrt(np.square(apart).mean())))
    )
