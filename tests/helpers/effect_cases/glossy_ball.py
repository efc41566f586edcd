"""A ball that mirrors lamps, and twelve cameras around it."""

from __future__ import annotations

import numpy as np
from box_scene import look_at, photograph
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import Camera, Rig
from scas4d_core.captures.frame import Frame
from scas4d_core.engines.cpu.gloss import colours_seen
from scas4d_core.engines.views import CameraArrays
from scas4d_core.gaussians import Gaussians
from scas4d_core.kernels.appearance.direction import CELLS, ROWS, SHEEN, SIDE

RADIUS, COUNT, SIZE = 0.3, 1500, 96


def rig() -> Rig:
    """Twelve cameras all round, at three heights."""
    angles = [(2 * np.pi * k / 12, (-0.7, 0.1, 0.8)[k % 3]) for k in range(12)]
    return Rig(tuple(look_at(f"c{k}", [np.sin(a), h, np.cos(a)], 140, SIZE) for k, (a, h) in enumerate(angles)))


def sphere(glossy: bool = True) -> Gaussians:
    """A ball with patches of colour, and lamps that it mirrors."""
    k = np.arange(COUNT) + 0.5
    z, turn = 1 - 2 * k / COUNT, np.pi * (1 + 5**0.5) * k
    normals = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
    axes = [Rotation.align_vectors([n], [[0, 0, 1]])[0].as_matrix() for n in normals]
    factors = np.stack(axes) * [0.013, 0.013, 0.003]
    colours = 0.15 + 0.4 * (np.sin(9 * normals) > 0)
    state = Gaussians.of_points(RADIUS * normals, 0.01, colours).replace(factors=factors.astype(np.float32))
    if not glossy:
        return state
    environment = np.zeros((ROWS, 3), np.float32)
    for cell in (5 * SIDE + 6, 10 * SIDE + 10, 12 * SIDE + 3):
        environment[[cell, cell + 1, cell + SIDE]] = 1.5
    environment[:CELLS] -= 0.05
    environment[SHEEN] = 0.4
    return state.replace(gloss=(0.5 * normals).astype(np.float32), environment=environment)


def picture(state: Gaussians, camera: Camera) -> np.ndarray:
    """[H, W, 3] 8 bit, as a camera sees it."""
    return photograph(state.replace(colours=colours_seen(state, CameraArrays.of(camera))), camera)[0]


def frame(state: Gaussians, index: int = 0) -> Frame:
    return Frame(index, float(index), {camera.name: picture(state, camera) for camera in rig().cameras}, {})
