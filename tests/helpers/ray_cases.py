"""Gaussians for ray tests: flat sheets and a random cloud."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import Camera
from scas4d_core.gaussians import Gaussians

CAMERA = Camera("c", np.array([[120.0, 0, 32], [0, 110, 24], [0, 0, 1]]), np.eye(4), 64, 48)


def gaussians(means, factors, opacities) -> Gaussians:
    n = len(means)
    return Gaussians(
        means=np.asarray(means, np.float32),
        factors=np.asarray(factors, np.float32),
        rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        opacities=np.asarray(opacities, np.float32),
        colours=np.zeros((n, 3), np.float32),
        foreground=np.ones(n, np.float32),
        ids=np.arange(n),
    )


def sheet(normal, offset: float, spacing: float = 0.02, opacity: float = 0.6) -> Gaussians:
    """A dense plane n·x = offset of thin Gaussians, about as wide as the picture."""
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    turn = Rotation.align_vectors([normal], [[0, 0, 1.0]])[0].as_matrix()
    a, b = np.meshgrid(np.arange(-1, 1, spacing), np.arange(-1, 1, spacing))
    flat = np.stack([a.ravel(), b.ravel(), np.zeros(a.size)], axis=1) @ turn.T
    means = flat + np.array([0, 0, offset / normal[2]])
    axes = turn * np.array([spacing, spacing, 1e-4])
    return gaussians(means, np.tile(axes, (len(means), 1, 1)), np.full(len(means), opacity))


def stacked(*parts: Gaussians) -> Gaussians:
    return Gaussians(**{name: np.concatenate([part.arrays()[name] for part in parts]) for name in parts[0].arrays()})


def random_cloud(n: int = 300) -> Gaussians:
    rng = np.random.default_rng(0)
    means = rng.uniform([-0.8, -0.6, 1.5], [0.8, 0.6, 3.0], size=(n, 3))
    axes = Rotation.random(n, random_state=1).as_matrix() * rng.uniform(0.01, 0.15, size=(n, 1, 3))
    return gaussians(means, axes, rng.uniform(0.05, 0.95, n))
