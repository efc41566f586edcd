"""States of a few hundred Gaussians that bend, are born and retire, as a compact file: all that its format can tell."""

from __future__ import annotations

import numpy as np

from scas4d_core.cameras import Rig
from scas4d_core.compact import CompactWriter, FileHeader
from scas4d_core.gaussians import Gaussians, quaternion_products

FRAMES = 7
BORN, LATER = 400, 25
"""Gaussians of the first frame, and of frame 14."""
PARTS = 3


def states(seed=3):
    """Index, time and state of each frame: numbers with gaps, some that stand, thin ones, ones that come and go."""
    draw = np.random.default_rng(seed)
    means = draw.normal(size=(BORN, 3)).astype(np.float32) * 0.5
    state = Gaussians.of_points(means, radius=0.06, colours=draw.uniform(size=(BORN, 3)).astype(np.float32))
    thin = np.where(np.arange(BORN) % 40 == 0, 0.001, 1.0).astype(np.float32)
    spread = draw.normal(scale=0.04, size=(BORN, 3, 3)).astype(np.float32) * thin[:, None, None]
    state = state.replace(
        factors=spread,
        foreground=np.where(np.arange(BORN) < 120, 0.1, 0.9).astype(np.float32),
        opacities=draw.uniform(0.02, 0.99, size=BORN).astype(np.float32),
        gloss=draw.normal(scale=0.2, size=(30, 3)).astype(np.float32),
        environment=draw.normal(size=(4, 3)).astype(np.float32),
    )
    for number in range(FRAMES):
        index = 10 + 2 * number
        if number:
            state = _bent(state, draw)
        if number == 2:
            more = Gaussians.of_points(draw.normal(size=(LATER, 3)) * 0.4, radius=0.05)
            state = state.concatenate(more)
            state = state.replace(ids=np.arange(len(state), dtype=np.int64) * 3)
        elif not number:
            state = state.replace(ids=np.arange(len(state), dtype=np.int64) * 3)
        if number == 3:
            state = state.retire([5, 130, 399])
        if number == 5:
            state = state.revive([130])
        yield index, 0.04 * index, state


def _bent(state, draw):
    moving = state.foreground > 0.5
    angle = np.float32(0.15) * state.means[:, 1] * moving
    cos, sin, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    turn = np.stack([cos, zero, sin, zero, one, zero, -sin, zero, cos], axis=1).reshape(-1, 3, 3)
    quaternions = np.stack([np.cos(angle / 2), zero, np.sin(angle / 2), zero], axis=1)
    shift = moving[:, None] * draw.normal(scale=0.004, size=state.means.shape) + moving[:, None] * [0.03, 0, 0.01]
    return state.replace(
        means=(np.einsum("nij,nj->ni", turn, state.means) + shift).astype(np.float32),
        factors=(turn @ state.factors * (1 + 0.03 * moving[:, None, None])).astype(np.float32),
        rotations=quaternion_products(quaternions, state.rotations).astype(np.float32),
        colours=(state.colours + draw.normal(scale=0.02, size=state.colours.shape)).astype(np.float32),
        foreground=np.clip(state.foreground + draw.normal(scale=0.02, size=len(state)), 0, 1).astype(np.float32),
    )


def write(path, rig: Rig, key_every=3):
    """The compact file of these states, of which frame 14 and the last tell parts."""
    with CompactWriter(
        path, FileHeader(rig.world_frame(2.0), rig=rig, background=(0.1, 0.2, 0.3)), key_every
    ) as writer:
        for index, time, state in states():
            writer.add(index, time, state)
            if index in (14, 22):
                writer.add_parts(index, np.arange(len(state)) % (PARTS + 1) - 1)
    return path
