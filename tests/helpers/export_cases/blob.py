"""A scene made by hand: a red blob that moves to the right before a grey wall that stands."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import Camera, Rig, WorldFrame
from scas4d_core.gaussians import Gaussians

WORLD = WorldFrame(np.array([100.0, -50, 30]), metres_per_unit=0.01)
"""The user works in centimetres."""
FRAMES, RATE = 5, 10.0
STEP = np.array([0.1, 0.0, 0.0])
"""Metres a frame."""
BLOB = 4
"""Rows of the blob: the first ones."""
BACKGROUND = (0.0, 0.0, 1.0)


def centre(frame):
    """Of the blob, metres."""
    return np.array([-0.2, 0.1, 2.0]) + frame * STEP


def state(frame):
    turn = Rotation.from_rotvec([0, 0, 0.2 * frame]).as_matrix()
    around = np.array([[1.0, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]]) * 0.02
    wall = np.stack(np.meshgrid(np.linspace(-1.5, 1.5, 17), np.linspace(-1.5, 1.5, 17), [3.0]), -1).reshape(-1, 3)
    made = Gaussians.of_points(np.concatenate([centre(frame) + around @ turn.T, wall]), 0.16, colours=0.5)
    moves = np.arange(len(made)) < BLOB
    colours = np.where(moves[:, None], np.float32([1, 0, 0]), made.colours)
    factors = np.where(moves[:, None, None], 0.05 * turn @ np.diag([1.0, 0.6, 0.3]), made.factors)
    rotations = made.rotations.copy()
    rotations[moves] = np.roll(Rotation.from_matrix(turn).as_quat(), 1)
    return made.replace(
        colours=colours.astype(np.float32),
        factors=factors.astype(np.float32),
        rotations=rotations,
        foreground=moves.astype(np.float32),
        ids=made.ids + 50,
    )


def make_rig():
    """Two cameras in the user's world, 2 m before the blob's way and looking at it."""
    lens = np.array([[100.0, 0, 40], [0, 100, 30], [0, 0, 1]])
    cameras = []
    for name, angle in (("front", 0.0), ("side", 0.6)):
        turn = Rotation.from_rotvec([0, angle, 0]).as_matrix()
        place = WORLD.to_user(np.array([0, 0.1, 2.0]) + turn @ [0, 0, -2.0])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn.T, -turn.T @ place
        cameras.append(Camera(name, lens, pose, 80, 60))
    return Rig(tuple(cameras))


def true_colour(frame):
    return (40 * frame, 120, 250 - 40 * frame)
