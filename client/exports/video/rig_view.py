"""Target point, up direction and radius of a rig, computed as in the viewer (docs/viewer.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Camera, Rig

Float = NDArray[np.float64]

PARALLEL = 1e-6
"""Determinant threshold, relative to the cube of the largest matrix entry.

Below it, the optical axes are considered parallel and have no common point.
"""
FAR = 20.0
"""Distance of the intersection, in rig radii, beyond which the optical axes are considered parallel."""


@dataclass(frozen=True, eq=False)
class RigView:
    """Target, up direction and radius derived from a rig, in the user's world and units.

    Attributes:
        target: point [3] closest to all optical axes or, if they are parallel, a point in front of the cameras.
        up: unit vector [3] opposite to the cameras' mean downward image direction, or −y if the mean is near zero.
        radius: median distance of the cameras from the target.

    >>> poses = np.stack([np.eye(4)] * 2)
    >>> poses[1, :3, :3] = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]  # the second camera is at x = -2 and looks along x
    >>> poses[:, :3, 3] = [0, 0, 2]
    >>> lens = [[100, 0, 32], [0, 100, 24], [0, 0, 1]]
    >>> view = RigView.of(Rig(tuple(Camera(str(k), lens, pose, 64, 48) for k, pose in enumerate(poses))))
    >>> view.target.round(6) + 0, view.up + 0, view.radius
    (array([0., 0., 0.]), array([ 0., -1.,  0.]), 2.0)
    """

    target: Float
    up: Float
    radius: float

    @classmethod
    def of(cls, rig: Rig) -> RigView:
        """Returns the target, up direction and radius of a rig."""
        centres = np.stack([camera.centre for camera in rig.cameras])
        ahead = np.stack([camera.rotation[2] for camera in rig.cameras])
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        down = np.sum([camera.rotation[1] for camera in rig.cameras], axis=0)
        size = np.linalg.norm(down)
        up = -down / size if size > 0.05 * len(rig) else np.array([0.0, -1.0, 0.0])
        mean = centres.mean(axis=0)
        spread = float(np.linalg.norm(centres - mean, axis=1).max()) or 1.0
        target = _nearest_to_axes(centres, ahead)
        if target is not None:
            in_front = np.einsum("nk,nk->n", target - centres, ahead) > 0
            if in_front.sum() < len(rig) / 2 or np.linalg.norm(target - mean) > FAR * spread:
                target = None
        if target is None:
            target = mean + 2 * spread * _unit(ahead.sum(axis=0))
        distances = np.sort(np.linalg.norm(centres - target, axis=1))
        return cls(target, up, float(distances[len(rig) // 2]) or 1.0)


def _nearest_to_axes(centres: Float, ahead: Float) -> Float | None:
    """Returns the point [3] with the smallest sum of squared distances to N lines, or None if it is not unique."""
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    matrix = across.sum(axis=0)
    if len(centres) < 2 or abs(np.linalg.det(matrix)) < PARALLEL * np.abs(matrix).max() ** 3:
        return None
    point: Float = np.linalg.solve(matrix, np.einsum("nij,nj->i", across, centres))
    return point


def _unit(vector: Float) -> Float:
    size = np.linalg.norm(vector)
    return vector / size if size > 0 else np.array([0.0, 0.0, 1.0])


def look_at(camera: Camera, eye: Float, target: Float, up: Float) -> Camera:
    """Returns the camera moved to ``eye`` [3] and oriented towards ``target`` [3], with up direction ``up`` [3].

    If the viewing direction is parallel to ``up``, the roll of the camera is arbitrary.

    >>> camera = Camera("a", [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4), 64, 48)
    >>> moved = look_at(camera, np.array([5.0, 0, 0]), np.zeros(3), np.array([0.0, -1, 0]))
    >>> moved.project([0, 0, 0])[0], moved.to_camera([0, -1, 0]).round(6) + 0
    (array([32., 24.]), array([ 0., -1.,  5.]))
    """
    ahead = _unit(target - eye)
    right = np.cross(ahead, up)
    if np.linalg.norm(right) < 1e-6 * np.linalg.norm(up):
        right = np.cross(ahead, np.eye(3)[np.abs(ahead).argmin()])
    right = _unit(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye
    return Camera(camera.name, camera.intrinsics, pose, camera.width, camera.height)
