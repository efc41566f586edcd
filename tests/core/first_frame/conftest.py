"""A textured box and a ball, seen by a ring of cameras: ray cast in numpy."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from scas4d_core.cameras import Camera, Rig
from scas4d_core.posed_pictures import PosedPicture

RADIUS = 0.45
HALF = np.array([0.5, 0.35, 0.4])


def looking_at(name: str, centre: np.ndarray, target: np.ndarray, size: int, focal: float) -> Camera:
    forward = target - centre
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.1, 1.0, 0.05])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
    matrix = np.array([[focal, 0, size / 2 + 1.5], [0, focal, size / 2 - 0.5], [0, 0, 1]])
    return Camera(name, matrix, pose, size, size)


def ring(count: int, size: int = 128, focal: float = 190.0, offset: np.ndarray | None = None) -> Rig:
    """Cameras on two circles, above and below, 2.6 units from the origin (or from ``offset``)."""
    target = np.zeros(3) if offset is None else offset
    cameras = []
    for i in range(count):
        azimuth, height = 2 * np.pi * i / count, 1.5 if i % 2 else -1.3
        flat = np.sqrt(2.6**2 - height**2)
        centre = target + np.array([flat * np.cos(azimuth), height, flat * np.sin(azimuth)])
        cameras.append(looking_at(f"c{i}", centre, target, size, focal))
    return Rig(tuple(cameras))


def texture(points: np.ndarray) -> np.ndarray:
    """[..., 3] colours 0.15…0.95 of points [..., 3]: smooth, without repetition at the scale of the box."""
    rng = np.random.default_rng(3)
    waves, phases = rng.normal(size=(24, 3)) * np.geomspace(4, 26, 24)[:, None], rng.uniform(0, 2 * np.pi, (24, 3))
    total = np.sin((points @ waves.T)[..., None] + phases).sum(-2)
    return 0.55 + 0.4 * np.tanh(total / 4)


def box_depth(camera: Camera, uv: np.ndarray) -> np.ndarray:
    """Depth of the box along the rays through pixels [..., 2], infinity where they pass by."""
    origin = camera.centre
    rays = camera.unproject(uv, np.ones(uv.shape[:-1])) - origin
    with np.errstate(divide="ignore"):
        low, high = (-HALF - origin) / rays, (HALF - origin) / rays
    near, far = np.minimum(low, high).max(-1), np.maximum(low, high).min(-1)
    return np.where((near <= far) & (near > 0), near, np.inf)


def picture(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """[H, W, 3] uint8 picture of the box before black, antialiased by 3 × 3 rays, and [H, W] uint8 mask."""
    centre = np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), -1)
    total = np.zeros((camera.height, camera.width, 3))
    for du in (-1 / 3, 0, 1 / 3):
        for dv in (-1 / 3, 0, 1 / 3):
            uv = centre + np.array([du, dv])
            depth = box_depth(camera, uv)
            hit = np.isfinite(depth)
            total[hit] += texture(camera.unproject(uv[hit], depth[hit])) / 9
    return np.rint(255 * total).astype(np.uint8), np.isfinite(box_depth(camera, centre)).astype(np.uint8)


def distance_to_box(points: np.ndarray) -> np.ndarray:
    """[P] unsigned distance to the surface of the box."""
    outside = np.abs(points) - HALF
    return np.where((outside <= 0).all(-1), -outside.max(-1), np.linalg.norm(np.maximum(outside, 0), axis=-1))


def points_on_box(count: int) -> np.ndarray:
    """[P, 3] random points on all six faces."""
    rng = np.random.default_rng(5)
    points = rng.uniform(-1, 1, (count, 3))
    face = rng.integers(0, 3, count)
    points[np.arange(count), face] = np.sign(points[np.arange(count), face])
    return points * HALF


def ball_views(count: int = 24) -> list[PosedPicture]:
    """Silhouettes of a ball about the origin, exact at the pixel centres."""
    views = []
    for camera in ring(count).cameras:
        uv = np.stack(np.meshgrid(np.arange(128) + 0.5, np.arange(128) + 0.5), -1)
        rays = camera.unproject(uv, np.ones((128, 128))) - camera.centre
        along = -(rays @ camera.centre) / (rays**2).sum(-1)
        nearest = np.linalg.norm(camera.centre + rays * along[..., None], axis=-1)
        views.append(PosedPicture(camera, np.zeros((128, 128, 3), np.uint8), nearest <= RADIUS))
    return views


@pytest.fixture(scope="session")
def scene() -> SimpleNamespace:
    """The functions of this file: a helper module cannot be imported where pytest imports by path."""
    return SimpleNamespace(
        ring=ring,
        texture=texture,
        box_depth=box_depth,
        picture=picture,
        distance_to_box=distance_to_box,
        points_on_box=points_on_box,
        ball_views=ball_views,
    )
