"""A synthetic scene for comparisons: a coloured ball above a floor, seen by a ring of cameras."""

from __future__ import annotations

import numpy as np

from scas4d_core.cameras import Camera, Rig
from scas4d_core.gaussians import Gaussians

SHIFT, TURN = np.array([0.015, 0.01, -0.01]), 0.05
"""Translation in metres and rotation about the vertical axis in radians between the first two frames."""


def rig(size: int, count: int = 6, *, turned: float = 0.0, names: str = "c") -> Rig:
    """Returns a ring of cameras with square images that look at the origin, alternately from below and above.

    The y axis points down.

    Args:
        size: width and height of the images in pixels.
        count: number of cameras; even, so that their mean position is the origin.
        turned: rotation of all cameras about the vertical axis, in radians.
        names: prefix of the camera names.
    """
    lens = np.array([[1.25 * size, 0, size / 2], [0, 1.25 * size, size / 2], [0, 0, 1]])
    cameras = []
    for k in range(count):
        angle = turned + 2 * np.pi * k / count
        eye = np.array([1.3 * np.sin(angle), 0.45 * (-1) ** k, 1.3 * np.cos(angle)])
        z = -eye / np.linalg.norm(eye)
        x = np.cross([0, 1, 0], z) / np.linalg.norm(np.cross([0, 1, 0], z))
        pose = np.eye(4)
        pose[:3, :3] = [x, np.cross(z, x), z]
        pose[:3, 3] = -pose[:3, :3] @ eye
        cameras.append(Camera(f"{names}{k}", lens, pose, size, size))
    return Rig(tuple(cameras))


def ball_on_a_floor(count: int, rng: np.random.Generator) -> Gaussians:
    """Creates a ball of radius 0.25 m with ``count`` moving Gaussians, and a floor with ``count // 4`` static ones."""
    standing, total = count // 4, count + count // 4
    normals = rng.normal(size=(count, 3))
    ball = 0.25 * normals / np.linalg.norm(normals, axis=1, keepdims=True)
    floor = rng.uniform(-0.6, 0.6, (standing, 3))
    floor[:, 1] = 0.3
    widths = np.concatenate([np.full(count, 0.9 / np.sqrt(count)), np.full(standing, 1.2 / np.sqrt(standing))])
    axes = np.linalg.qr(rng.normal(size=(total, 3, 3)))[0]
    lengths = widths[:, None] * np.exp(rng.normal(0, 0.3, (total, 3)))
    return Gaussians(
        means=np.concatenate([ball, floor]).astype(np.float32),
        factors=(axes * lengths[:, None, :]).astype(np.float32),
        rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (total, 1)),
        opacities=rng.uniform(0.3, 0.9, total).astype(np.float32),
        colours=rng.uniform(0.05, 0.95, (total, 3)).astype(np.float32),
        foreground=np.where(np.arange(total) < count, 0.98, 0.02).astype(np.float32),
        ids=np.arange(total),
    )


def moved(before: Gaussians) -> Gaussians:
    """Returns a copy in which the moving Gaussians are rotated about the vertical axis and then shifted."""
    c, s = np.cos(TURN), np.sin(TURN)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    means, factors, rows = before.means.copy(), before.factors.copy(), before.moving
    means[rows] = before.means[rows] @ turn.T + SHIFT
    factors[rows] = turn @ before.factors[rows]
    return before.replace(means=means, factors=factors)
