"""Comparison of the moving parts of an exported asset, read back with pygltflib, with their true poses.

The Hungarian algorithm matches true parts and nodes one to one. It maximizes the number of points in frame 0 that
belong to the node of their true part. The comparison covers the motion since frame 0: the angle of the residual
rotation, and the mean position error over the points of the part.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from client.importers.open_source import open_source
from scas4d_core.captures.ground_truth import TruePart
from scas4d_core.exports.sequence import export_sequence
from scas4d_core.query.parts import parts
from scas4d_core.settings import Settings
from scas4d_core.storage.history import History
from studies.exports.gltf import open_gltf

Float = NDArray[np.float64]

Y_UP = np.diag([1.0, -1.0, -1.0])
COVERED = 0.5
"""Share of a true part's points that its node must contain for the part to count as found."""
BAR_PERCENT, BAR_DEGREES = 1.0, 2.0


@dataclass(frozen=True, eq=False)
class Node:
    """A node of the asset.

    Attributes:
        name: node name.
        places: [N, 3] positions of its Gaussians in frame 0, in user coordinates.
        motion: [T, 4, 4] motion since frame 0, in user coordinates. NaN in frames without a key.
    """

    name: str
    places: Float
    motion: Float


@dataclass(frozen=True, eq=False)
class PartFigures:
    """Errors of one part of the ground truth.

    Attributes:
        part: part name.
        static: whether the part is static in the ground truth.
        points: number of points of the part.
        node: name of the matching node of the asset, or "none".
        share: fraction of the part's points that the node contains.
        degrees: [T − 1] rotation error in each frame after the first.
        percent: [T − 1] mean position error over the points in each frame after the first, in percent of the extent.
    """

    part: str
    static: bool
    points: int
    node: str
    share: float
    degrees: Float
    percent: Float

    @property
    def covered(self) -> bool:
        """Whether the matching node contains at least the share ``COVERED`` of the part's points."""
        return self.share >= COVERED


@dataclass(frozen=True, eq=False)
class AssetFigures:
    """Measurements of an asset.

    Attributes:
        count: how the number of parts was chosen, in words.
        nodes: number of moving parts in the asset.
        parts: errors of the true parts.
    """

    count: str
    nodes: int
    parts: list[PartFigures]

    def medians(self, moving: bool = False) -> tuple[float, float]:
        """Returns the median errors in degrees and percent of the extent, over the covered parts and their frames.

        Args:
            moving: whether to use only the parts that move in the ground truth.
        """
        chosen = [one for one in self.parts if one.covered and not (moving and one.static)]
        if not chosen:
            return float("nan"), float("nan")
        degrees, percent = (np.concatenate([getattr(one, name) for one in chosen]) for name in ("degrees", "percent"))
        return float(np.nanmedian(degrees)), float(np.nanmedian(percent))


def measure_asset(folder: Path, states: Path) -> list[AssetFigures]:
    """Exports the asset of a whole capture, first with the number of parts chosen by rule, then with the true one.

    Args:
        folder: capture folder. Without ground truth of moving rigid parts, the result is empty.
        states: folder that contains the capture's committed states.
    """
    capture = open_source(folder)
    truth = capture.ground_truth
    if truth is None:
        return []
    history = History.load(states)
    world = capture.full_rig.world_frame(Settings().scene.metres_per_unit)
    wanted = [part for part in truth.parts if part.foreground and part.rigid]
    if not any(part.pose is not None and not part.static for part in wanted):
        return []
    figures = []
    with TemporaryDirectory() as temporary:
        for words, count in (("by rule", None), ("as the truth", len(wanted))):
            labels = parts(history, count)
            file = Path(temporary) / "asset.glb"
            coming = ((index, history.time(index), history.gaussians(index)) for index in history.indices)
            export_sequence(coming, "glb-parts", file, world=world, parts=labels)
            nodes = read_asset(file, history.times - history.times[0])
            extent = capture.extent or float(np.ptp(truth.points.reshape(-1, 3), axis=0).max())
            compared = compare(nodes, wanted, truth.points[0], truth.part_id, history.indices, extent)
            figures.append(AssetFigures(words, len([node for node in nodes if node.name != "static"]), compared))
    return figures


def read_asset(file: Path, seconds: Float) -> list[Node]:
    """Reads the nodes of an asset and their animated poses.

    Args:
        file: file in format `glb-parts`.
        seconds: [T] time of each frame in seconds, relative to the first.
    """
    document, accessor = open_gltf(file)
    unit = document.asset.extras["metres_per_unit"]

    (animation,) = document.animations
    keyed: dict[int, dict[str, tuple[Float, Float]]] = {}
    for channel in animation.channels:
        sampler = animation.samplers[channel.sampler]
        keys = keyed.setdefault(channel.target.node, {})
        keys[channel.target.path] = (accessor(sampler.input), accessor(sampler.output))
    nodes = []
    for number, node in enumerate(document.nodes):
        own = accessor(document.meshes[node.mesh].primitives[0].attributes.POSITION)
        poses = np.tile(np.eye(4), (len(seconds), 1, 1))
        if number in keyed:
            poses[:] = np.nan  # a part has no key where it is absent
            for path, (times, values) in keyed[number].items():
                rows = np.abs(seconds[:, None] - times[None]).argmin(axis=0)
                if path == "rotation":
                    poses[rows, :3, :3] = Y_UP @ Rotation.from_quat(values).as_matrix() @ Y_UP
                else:
                    poses[rows, :3, 3] = values @ Y_UP / unit
            poses[:, 3] = [0, 0, 0, 1]
        places = own @ Y_UP / unit @ poses[0, :3, :3].T + poses[0, :3, 3]
        nodes.append(Node(node.name, places, poses @ np.linalg.inv(poses[0])))
    return nodes


def compare(
    nodes: list[Node],
    wanted: list[TruePart],
    points: Float,
    part_id: NDArray[np.int64],
    frames: list[int],
    extent: float,
) -> list[PartFigures]:
    """Matches the parts of the ground truth with nodes and compares their motions.

    Args:
        nodes: nodes of the asset.
        wanted: ground truth parts.
        points: [P, 3] true points in frame 0.
        part_id: [P] id of the part to which each point belongs.
        frames: the T frames of the capture.
        extent: extent of the scene in the user's unit.
    """
    places = np.concatenate([node.places for node in nodes])
    of_node = np.repeat(np.arange(len(nodes)), [len(node.places) for node in nodes])
    nearest = of_node[cKDTree(places).query(points)[1]]
    held = np.array([np.bincount(nearest[part_id == part.id], minlength=len(nodes)) for part in wanted])
    rows, columns = linear_sum_assignment(-held)
    matched: Mapping[int, int] = dict(zip(rows.tolist(), columns.tolist(), strict=True))
    figures = []
    for number, part in enumerate(wanted):
        own = points[part_id == part.id]
        node = nodes[matched[number]] if number in matched and held[number, matched[number]] else None
        if node is None or part.pose is None:
            none = np.full(len(frames) - 1, np.nan)
            figures.append(PartFigures(part.name, part.static, len(own), "none", 0.0, none, none))
            continue
        share = held[number, matched[number]] / max(len(own), 1)
        true = part.pose[frames] @ np.linalg.inv(part.pose[frames[0]])
        figures.append(
            PartFigures(part.name, part.static, len(own), node.name, share, *errors(node.motion, true, own, extent))
        )
    return figures


def errors(found: Float, true: Float, points: Float, extent: float) -> tuple[Float, Float]:
    """Returns the [T − 1] rotation errors in degrees and position errors in percent of the extent after frame 0.

    Args:
        found: [T, 4, 4] reconstructed motion.
        true: [T, 4, 4] true motion.
        points: [M, 3] points in frame 0.
        extent: extent of the scene in the unit of the points.
    >>> turned = np.tile(np.eye(4), (2, 1, 1))
    >>> turned[1, :3, :3] = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    >>> degrees, percent = errors(turned, np.tile(np.eye(4), (2, 1, 1)), np.array([[1.0, 0, 0]]), 2.0)
    >>> degrees.round(6), percent.round(6)
    (array([90.]), array([70.710678]))
    """
    left = found[1:, :3, :3] @ true[1:, :3, :3].transpose(0, 2, 1)
    cosine = (np.trace(left, axis1=1, axis2=2) - 1) / 2
    sine = np.linalg.norm(left - left.transpose(0, 2, 1), axis=(1, 2)) / np.sqrt(8)
    moved = [points @ each[1:, :3, :3].transpose(0, 2, 1) + each[1:, None, :3, 3] for each in (found, true)]
    apart = np.linalg.norm(moved[0] - moved[1], axis=2).mean(axis=1)
    return np.degrees(np.arctan2(sine, cosine)), 100 * apart / extent


def told_asset(figures: list[AssetFigures]) -> str:
    """Formats the measurements as a Markdown table.

    For each asset, there is one row per true part, and one row for all covered parts.
    """
    head = "| parts | true part | points | in the node | rotation, median (worst) | at its points, median (worst) |"
    rows = [head, "|---|---|---|---|---|---|"]
    for one in figures:
        for part in one.parts:
            if part.covered:
                turn = f"{np.nanmedian(part.degrees):.2f}° ({np.nanmax(part.degrees):.2f}°)"
                shift = f"{np.nanmedian(part.percent):.3f}% ({np.nanmax(part.percent):.3f}%)"
            else:
                turn = shift = "not found"
            rows.append(f"| | {part.part} | {part.points} | {part.share:.0%} | {turn} | {shift} |")
        covered = sum(part.covered for part in one.parts)
        (degrees, percent), moving = one.medians(), one.medians(moving=True)
        met = "reached" if degrees <= BAR_DEGREES and percent <= BAR_PERCENT else "missed"
        rows.append(
            f"| {one.nodes}, {one.count} | **{covered} of {len(one.parts)} parts** | | | **{degrees:.2f}°**, moving "
            f"ones {moving[0]:.2f}° | **{percent:.3f}%**, moving ones {moving[1]:.3f}% (bar: {BAR_DEGREES:g}°, "
            f"{BAR_PERCENT:g}%: {met}) |"
        )
    return "\n".join(rows)
