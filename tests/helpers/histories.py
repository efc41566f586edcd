"""Histories of random states, and the comparison of states."""

from __future__ import annotations

import numpy as np

from scas4d_core.gaussians import Gaussians
from scas4d_core.storage.history import History


def state(seed: int, n: int = 7) -> Gaussians:
    rng = np.random.default_rng(seed)
    rotations = rng.normal(size=(n, 4))
    return Gaussians(
        means=rng.normal(size=(n, 3)).astype(np.float32),
        factors=rng.normal(size=(n, 3, 3)).astype(np.float32),
        rotations=(rotations / np.linalg.norm(rotations, axis=1, keepdims=True)).astype(np.float32),
        opacities=np.linspace(0.1, 0.9, n, dtype=np.float32),
        colours=rng.random((n, 3)).astype(np.float32),
        foreground=rng.random(n).astype(np.float32),
        ids=np.arange(n, dtype=np.int64) + 100,
    )


def filled(history: History, frames: int = 9) -> History:
    for t in range(frames):
        history.append(2 * t, t / 30, state(t))
    return history


def same(a: Gaussians, b: Gaussians) -> bool:
    other = b.arrays()
    return all(np.array_equal(x, other[name]) and x.dtype == other[name].dtype for name, x in a.arrays().items())
