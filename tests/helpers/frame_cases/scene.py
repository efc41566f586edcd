"""Small scene of the frame cases and the soak test: one ball circles over a floor, another one is at rest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scas4d_core.gaussians import Gaussians

ORBIT = 0.14
"""Radius of the moving ball's orbit, in metres."""
BALL = 0.15
"""Radius of the moving ball, in metres."""
GOES, RESTS, STANDS = 220, 160, 64
"""Number of Gaussians of the moving ball, of the resting ball and of the floor, in this order."""


def first_state(*, resting_may_move: bool) -> Gaussians:
    """Returns Θ_0, the state of frame 0, in metres of the internal world.

    Args:
        resting_may_move: whether the resting ball is labelled as moving.
    """
    rng = np.random.default_rng(0)
    positions, widths = [], []
    for count, centre, radius in ((GOES, (ORBIT, -0.1, 0.0), BALL), (RESTS, (-0.1, 0.2, -0.25), 0.12)):
        normals = rng.normal(size=(count, 3))
        positions.append(np.array(centre) + radius * normals / np.linalg.norm(normals, axis=1, keepdims=True))
        widths.append(np.full(count, 1.6 * radius / np.sqrt(count)))
    line = 1.2 * ((np.arange(8) + 0.5) / 8 - 0.5)
    x, z = (array.ravel() for array in np.meshgrid(line, line))
    positions.append(np.stack([x, np.full(STANDS, 0.35), z], axis=1))
    total = GOES + RESTS + STANDS
    axes = np.linalg.qr(rng.normal(size=(total, 3, 3)))[0]
    lengths = np.exp(rng.normal(0, 0.2, (total, 3)))
    lengths[:-STANDS] *= np.concatenate(widths)[:, None]
    factors = axes * lengths[:, None, :]
    factors[-STANDS:] = np.diag([0.08, 0.01, 0.08])
    return Gaussians(
        means=np.concatenate(positions).astype(np.float32),
        factors=factors.astype(np.float32),
        rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (total, 1)),
        opacities=np.full(total, 0.9, np.float32),
        colours=rng.uniform(0.05, 0.95, (total, 3)).astype(np.float32),
        foreground=np.repeat(
            np.array([0.98, 0.98 if resting_may_move else 0.02, 0.02], np.float32), [GOES, RESTS, STANDS]
        ),
        ids=np.arange(total),
    )


def gone(state: Gaussians, angle: float, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Gaussians:
    """Returns the state with the moving ball rotated by ``angle`` radians about the vertical axis, then shifted."""
    means, factors = state.means.copy(), state.factors.copy()
    turn = np.eye(3)
    if angle != 0:
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    means[:GOES] = (state.means[:GOES] @ turn.T + shift).astype(np.float32)
    factors[:GOES] = (turn @ state.factors[:GOES]).astype(np.float32)
    return state.replace(means=means, factors=factors)


def rows() -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Returns masks [N] of the Gaussians of the moving ball and of the resting ball."""
    index = np.arange(GOES + RESTS + STANDS)
    return index < GOES, (index >= GOES) & (index < GOES + RESTS)
