"""Writes an articulated asset: one ``.glb`` with a node per part that contains the part's splats and rigid motion.

Each node contains the part's Gaussians as they are in the first frame, in the part's local
coordinates. A linear animation contains the part's translation and rotation, with times in seconds
since the first frame. Gaussians without a part do not move and are stored in the node ``static``.
Axes, units and attributes are the same as in ``gltf``. Deformation within a part, Gaussians born
later, and changes of colour and size are lost. Highlights rotate with the part instead of staying
fixed in the world.

The ``extras`` of a node report the residual of the part's rigid motion. The residual of a frame is
the weighted RMS distance between the means and their rigid prediction. ``residual_rms`` is the RMS
of the residuals of all frames after the first. ``residual_worst`` is the largest of these
residuals, and ``worst_frame`` is the index of its frame. Both residuals are in the user's units.
The values with the suffix ``_percent`` are percentages of the extent of the moving Gaussians in the
first frame.

The extras of a node that has a joint with another node contain ``joint``: its ``kind`` (``revolute``, ``prismatic`` or
``spherical``), the name of the ``parent`` node, and ``axis`` and ``centre`` in the parent's local coordinates. Hinges
and sliders have ``values``: the angle in radians or the distance in metres at each of the node's keyframes, null where
the parent is absent. ``error`` is the RMS distance between the child's points and the prediction by the joint, in the
user's units.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import WorldFrame
from scas4d_core.errors import InputError, exact
from scas4d_core.exports.atomic_files import check_writable
from scas4d_core.exports.cloud import HALF_TURN, Cloud, cloud_of
from scas4d_core.exports.glb import Binary
from scas4d_core.exports.gltf import EXTENSION, asset_extras, splat_primitive
from scas4d_core.gaussians import Gaussians
from scas4d_core.query.joints import find_joints
from scas4d_core.query.part_motion import PartMotion, PartPose, PartTrack, quaternion_of, still_track

Float = NDArray[np.float64]


@dataclass
class _Keyframes:
    """Keyframes of one part's animation in glTF's axes and units; motions and residuals in the user's."""

    times: list[float] = field(default_factory=list)
    frames: list[int] = field(default_factory=list)
    motions: list[Float] = field(default_factory=list)
    positions: list[Float] = field(default_factory=list)
    quaternions: list[Float] = field(default_factory=list)
    residuals: list[float] = field(default_factory=list)

    def add(self, index: int, seconds: float, pose: PartPose, metres: float) -> None:
        quaternion = quaternion_of(HALF_TURN @ pose.rotation @ HALF_TURN)
        if self.quaternions and quaternion @ self.quaternions[-1] < 0:
            quaternion = -quaternion  # interpolate along the shorter arc
        self.times.append(seconds)
        self.frames.append(index)
        self.motions.append(pose.motion)
        self.positions.append(HALF_TURN @ pose.position * metres)
        self.quaternions.append(quaternion)
        self.residuals.append(pose.residual)


class PartAsset:
    """Writer of an articulated asset. The file is written by ``finish``.

    Only the first frame and the pose of each part in each frame are kept in memory.

    Args:
        path: path of the file.
        world: transform from the user's world to the internal world.
        labels: [N] part label of each Gaussian, negative for none.

    Raises:
        InputError: if the folder is not writable.

    >>> from tempfile import TemporaryDirectory
    >>> state = Gaussians.of_points([[0, 0, 2], [1, 0, 2], [0, 1, 2]], radius=0.1)
    >>> with TemporaryDirectory() as folder:
    ...     asset = PartAsset(f"{folder}/a.glb", WorldFrame(np.zeros(3)), np.zeros(3, int))
    ...     for index in range(3):
    ...         moved = state.replace(means=state.means + np.float32([0, 0, index]))
    ...         asset.add(index, index / 30, moved)
    ...     asset.finish()
    ...     b'"animations"' in Path(f"{folder}/a.glb").read_bytes()
    True
    """

    def __init__(self, path: Path | str, world: WorldFrame, labels: NDArray[Any]) -> None:
        self.path = Path(path)
        check_writable(self.path)
        self._world = world
        self._labels = labels
        self._motion: PartMotion | None = None
        self._first: Gaussians | None = None
        self._begin = self._latest = 0.0
        self._keys: dict[int, _Keyframes] = {}

    def add(self, index: int, time: float, gaussians: Gaussians) -> None:
        """Adds a frame.

        Args:
            index: frame index.
            time: time in seconds, later than all previous times.
            gaussians: state in the internal world.

        Raises:
            InputError: if the time does not increase, or no Gaussian of the first frame belongs to a part.
        """
        if self._motion is None:
            self._motion = PartMotion(self._labels, gaussians, self._world)
            self._first, self._begin = gaussians, time
            self._keys = {part: _Keyframes() for part in self._motion.parts}
        elif not time > self._latest:
            raise InputError(
                f"time {exact(time)} s of frame {index} is not later than the previous frame, {exact(self._latest)} s",
                "add frames in chronological order",
            )
        self._latest = time
        for pose in self._motion.poses(gaussians):
            self._keys[pose.part].add(index, time - self._begin, pose, self._world.metres_per_unit)

    def finish(self) -> None:
        """Writes the file atomically.

        Raises:
            InputError: if no frame was added, some Gaussians cannot be exported, or the file cannot
                be written.
        """
        if self._motion is None or self._first is None:
            raise InputError("there are no frames to export", "add at least one frame")
        cloud = cloud_of(self._first, self._world, retired=True).scaled(self._world.metres_per_unit).half_turned()
        binary = Binary()
        nodes: list[dict[str, Any]] = []
        meshes: list[dict[str, Any]] = []
        samplers: list[dict[str, Any]] = []
        channels: list[dict[str, Any]] = []
        times: dict[tuple[float, ...], int] = {}  # parts with the same times share an accessor
        left = self._first.present.copy()
        joints = self._joints()
        for part, keys in self._keys.items():
            rows = self._motion.rows(part)
            left[rows] = False
            node = {
                "name": f"part {part}",
                "mesh": len(meshes),
                "translation": keys.positions[0].tolist(),
                "rotation": np.roll(keys.quaternions[0], -1).tolist(),
                "extras": {"part": part, **self._residuals(keys), **joints.get(part, {})},
            }
            meshes.append({"primitives": [splat_primitive(binary, _moved(cloud.rows(rows), -keys.positions[0]))]})
            if tuple(keys.times) not in times:
                times[tuple(keys.times)] = binary.add(np.asarray(keys.times, "<f4"), bounds=True)
            rotations = np.roll(np.stack(keys.quaternions), -1, axis=1)
            for name, values in (("translation", np.stack(keys.positions)), ("rotation", rotations)):
                channels.append({"sampler": len(samplers), "target": {"node": len(nodes), "path": name}})
                output = binary.add(np.asarray(values, "<f4"))
                samplers.append({"input": times[tuple(keys.times)], "output": output, "interpolation": "LINEAR"})
            nodes.append(node)
        if left.any():
            nodes.append({"name": "static", "mesh": len(meshes)})
            meshes.append({"primitives": [splat_primitive(binary, cloud.rows(left))]})
        binary.write(
            self.path,
            {
                "scene": 0,
                "scenes": [{"nodes": list(range(len(nodes)))}],
                "nodes": nodes,
                "meshes": meshes,
                "animations": [{"name": "motion", "samplers": samplers, "channels": channels}],
                "extensionsUsed": [EXTENSION],
                "asset_extras": asset_extras(self._world) | {"first_time_s": self._begin},
            },
        )

    def discard(self) -> None:
        """Discards the collected frames; no file has been created yet."""
        self._first, self._motion, self._keys = None, None, {}

    def _joints(self) -> dict[int, dict[str, Any]]:
        """Returns the extras that describe the joint of each part with its parent, keyed by the part's label."""
        assert self._motion is not None
        assert self._first is not None
        frames = sorted({index for keys in self._keys.values() for index in keys.frames})
        tracks = [still_track(self._first, self._labels, self._world, len(frames))]
        for part, keys in self._keys.items():
            motions = np.full((len(frames), 4, 4), np.nan)
            motions[np.searchsorted(frames, keys.frames)] = keys.motions
            tracks.append(PartTrack(part, motions, np.zeros(len(frames)), *self._motion.points(part)))
        extras = {}
        for joint in find_joints(tracks, self._motion.extent):
            metres = self._world.metres_per_unit
            parent, child = self._keys.get(joint.parent), self._keys[joint.child]
            centre = HALF_TURN @ joint.centres[0] * metres - (0 if parent is None else parent.positions[0])
            values = joint.values[np.searchsorted(frames, child.frames)]
            described: dict[str, Any] = {
                "kind": joint.kind,
                "parent": "static" if parent is None else f"part {joint.parent}",
                "centre": centre.tolist(),
                "error": joint.error,
            }
            if joint.kind != "spherical":
                known = np.isfinite(values).tolist()
                values = values * (metres if joint.kind == "prismatic" else 1.0)
                described["axis"] = (HALF_TURN @ joint.axes[0]).tolist()
                described["values"] = [value if ok else None for value, ok in zip(values.tolist(), known, strict=True)]
            extras[joint.child] = {"joint": described}
        return extras

    def _residuals(self, keys: _Keyframes) -> dict[str, Any]:
        """Returns the extras of a part, which describe the residual of its rigid motion."""
        assert self._motion is not None
        after = np.array(keys.residuals[1:] or [0.0])
        rms, worst = float(np.sqrt(np.mean(np.square(after)))), int(after.argmax())
        percent = 100 / self._motion.extent if self._motion.extent > 0 else 0.0
        return {
            "residual_rms": rms,
            "residual_rms_percent": rms * percent,
            "residual_worst": float(after[worst]),
            "residual_worst_percent": float(after[worst]) * percent,
            "worst_frame": (keys.frames[1:] or keys.frames)[worst],
            "frames": len(keys.frames),
        }


def _moved(cloud: Cloud, by: Float) -> Cloud:
    return replace(cloud, splats=replace(cloud.splats, means=cloud.splats.means + by))
