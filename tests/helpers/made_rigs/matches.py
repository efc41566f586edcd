"""A made-up rig around random points, and the matches that it would have; no picture is needed."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import Camera, Rig
from scas4d_core.first_frame.calibration.matches import Matches, neighbour_pairs

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0


def ring(count=9, radius=3.0):
    """Cameras on a wavy ring that look at the origin."""
    cameras = []
    for index in range(count):
        angle = 2 * np.pi * index / count
        centre = radius * np.array([np.cos(angle), 0.25 * np.cos(3 * angle), np.sin(angle)])
        forward = -centre / np.linalg.norm(centre)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = [right, np.cross(forward, right), forward]
        pose[:3, 3] = -pose[:3, :3] @ centre
        lens = [[FOCAL, 0, WIDTH / 2], [0, 1.1 * FOCAL, HEIGHT / 2], [0, 0, 1]]
        cameras.append(Camera(f"c{index}", lens, pose, WIDTH, HEIGHT))
    return cameras


def turned(camera, pixels, axis=(1.0, 0.0, 0.0)):
    """The camera turned about an axis of its own such that its picture moves by so many pixels."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec(np.array(axis) * pixels / camera.fx).as_matrix()
    return Camera(camera.name, camera.intrinsics, turn @ camera.world_to_camera, camera.width, camera.height)


def longer(camera, factor):
    """The camera with another focal length."""
    return Camera(camera.name, camera.intrinsics * [[factor], [factor], [1]], camera.world_to_camera, WIDTH, HEIGHT)


def matches_of(cameras, points=250, noise=0.25, wrong=0.05, seed=0):
    """The matches of a right rig: each point is seen by two thirds of the cameras; some match another point."""
    rng = np.random.default_rng(seed)
    cloud = rng.uniform(-0.7, 0.7, (points, 3))
    pixels, seen = [], []
    for camera in cameras:
        uv = camera.project(cloud)[0] + rng.normal(size=(points, 2)) * noise
        pixels.append(uv)
        seen.append(rng.random(points) < 2 / 3)
    pairs = {}
    for a, b in neighbour_pairs(Rig(tuple(cameras))):
        rows = np.flatnonzero(seen[a] & seen[b])
        other = np.where(rng.random(len(rows)) < wrong, rng.permutation(rows), rows)
        pairs[a, b] = np.stack([rows, other], axis=1)
    return Matches(tuple(cameras), np.ones(len(cameras)), pixels, pairs)


def off_by(true, found):
    """Pixels by which each camera sees points elsewhere than it should, median."""
    cloud = np.random.default_rng(9).uniform(-0.7, 0.7, (100, 3))
    pairs = zip(true, found, strict=True)
    return np.array([np.median(np.linalg.norm(a.project(cloud)[0] - b.project(cloud)[0], axis=1)) for a, b in pairs])
