"""A small room that a ball enters: a floor, a smaller ball that lies there, twelve cameras around."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import Rig
from scas4d_core.effects.evidence import FrameObservation
from scas4d_core.engines.choose import Device, renderer_of
from scas4d_core.engines.limits import scene_limits
from scas4d_core.gaussians import Gaussians
from scas4d_core.update.result import UpdateResult, UpdateTrace
from scas4d_core.update.view_factory import ViewFactory
from tests.helpers.box_scene import look_at, take_frame

SIZE = 80
FLOOR, BALL = 0.3, 0.16
"""Metres: the floor's height (y is down), the ball's radius."""
CENTRE = np.array([0.3, -0.05, 0.1])
"""Of the ball."""
BOX = np.array([-0.3, 0.2, -0.1])


def make_rig() -> Rig:
    """Twelve cameras on a circle, above the floor; they see all of it that matters."""
    angles = 2 * np.pi * np.arange(12) / 12
    return Rig(
        tuple(look_at(f"c{k}", [1.5 * np.sin(a), -0.8, 1.5 * np.cos(a)], 95.0, SIZE) for k, a in enumerate(angles))
    )


def _flat(points: np.ndarray, normals: np.ndarray, width: float, colours: np.ndarray, moves: bool) -> Gaussians:
    turns = Rotation.concatenate([Rotation.align_vectors([normal], [[0, 0, 1.0]])[0] for normal in normals])
    made = Gaussians.of_points(points, width, colours)
    factors = (turns.as_matrix() * [width, width, 0.2 * width]).astype(np.float32)
    return made.replace(
        factors=factors,
        opacities=np.full(len(points), 0.95, np.float32),
        foreground=np.full(len(points), float(moves), np.float32),
    )


def _pattern(points: np.ndarray, phase: float) -> np.ndarray:
    waves = np.sin(np.asarray(points) @ np.array([[9.0, 3, 1], [-2, 8, 3], [4, -3, 9]]).T + phase)
    return 0.5 + 0.35 * waves


def floor(hole: float = 0.0) -> Gaussians:
    """The floor, without what lies nearer to the box's middle than ``hole`` metres."""
    line = np.linspace(-1, 1, 41)
    x, z = (array.ravel() for array in np.meshgrid(line, line))
    points = np.stack([x, np.full(len(x), FLOOR), z], axis=1)
    points = points[np.hypot(x - BOX[0], z - BOX[2]) >= hole]
    return _flat(points, np.tile([0, -1.0, 0], (len(points), 1)), 0.035, _pattern(points, 0.0), moves=False)


def sphere(centre: np.ndarray, radius: float, phase: float) -> Gaussians:
    """A ball of 300 Gaussians, with a pattern that is fixed to it."""
    k = np.arange(300) + 0.5
    polar, around = np.arccos(1 - 2 * k / 300), np.pi * (1 + 5**0.5) * k
    normals = np.stack([np.cos(around) * np.sin(polar), np.cos(polar), np.sin(around) * np.sin(polar)], axis=1)
    return _flat(centre + radius * normals, normals, 0.1 * radius, _pattern(3 * normals, phase), moves=True)


def scene(*things: Gaussians, hole: float = 0.0) -> Gaussians:
    """The floor with some things, ids in order."""
    state = floor(hole)
    for thing in things:
        state = state.concatenate(thing)
    return state.replace(ids=np.arange(len(state)))


def visitor(centre: np.ndarray = CENTRE) -> Gaussians:
    """The ball that comes in."""
    return sphere(np.asarray(centre), BALL, 2.0)


def known(centre: np.ndarray = BOX) -> Gaussians:
    """What is there from the first frame on, and moves."""
    return sphere(np.asarray(centre), 0.1, 0.5)


def seen(
    state: Gaussians,
    true: Gaussians,
    index: int = 5,
    masks: bool = True,
    carried: dict[str, Any] | None = None,
    device: Device = "cpu",
) -> FrameObservation:
    """A frame that shows ``true``, updated to ``state``."""
    rig = make_rig()
    factory = ViewFactory(rig)
    views = factory.views(take_frame(index, float(index), true, rig, masks), {})
    renderer = renderer_of(device, (0.0, 0.0, 0.0), scene_limits("auto", rig.radius))
    return FrameObservation(
        index, state, UpdateResult(state, None, UpdateTrace(), carried=carried or {}), rig, views, renderer
    )


def psnr(state: Gaussians, frame: FrameObservation) -> float:
    """DB of a state, mean over the views of a frame."""
    return float(np.mean([one.psnr for one in frame.renderer.compare(state, frame.views)]))
