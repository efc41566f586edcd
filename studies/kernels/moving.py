"""Time of an update against the share of the pixels that show something that moves, on made-up footage.

A textured wall is seen by a row of cameras; a square in its middle slides, as large as the share asks for.
All variants have the same Gaussians, cameras and settings; they are updated in turns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from scas4d_core.cameras import Camera, Rig
from scas4d_core.captures.frame import Frame
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.gaussians import Gaussians
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings
from studies.kernels.synthetic import photograph

SIDE = 150
"""Gaussians of a side of the wall: as many in all as a captured object has."""
SIZE = 256
"""Pixels of a picture's side."""
CAMERAS = 12
WIDTH_M, AWAY_M = 2.0, 3.0
"""Of the wall; the cameras before it."""
SLIDE_M = 0.008
"""That the square slides in a frame: a pixel."""
RATE = 30.0
"""Frames a second."""


@dataclass(frozen=True)
class MovingTime:
    """Times of a variant.

    Attributes:
        share: of the pixels that show something that moves, asked for. moving: Gaussians that move. seconds: median of
            an update. psnr: dB, mean over the cameras at the last update.
    """

    share: float
    moving: int
    seconds: float
    psnr: float


def wall(share: float) -> Gaussians:
    """A wall whose middle moves; its sides are as long as it takes to fill the share."""
    lines = np.linspace(-WIDTH_M / 2, WIDTH_M / 2, SIDE)
    x, y = (axis.ravel() for axis in np.meshgrid(lines, lines))
    rng = np.random.default_rng(5)
    soft = np.kron(rng.uniform(0.1, 0.9, (SIDE // 3, SIDE // 3, 3)), np.ones((3, 3, 1))).reshape(-1, 3)
    points = np.stack([x, y, 0.01 * rng.standard_normal(len(x))], axis=1)
    found = Gaussians.of_points(points, radius=0.6 * WIDTH_M / SIDE, colours=soft)
    moves = np.maximum(np.abs(x), np.abs(y)) <= np.sqrt(share) * WIDTH_M / 2 + 1e-9
    return found.replace(foreground=moves.astype(np.float32))


def rig() -> Rig:
    """A row of cameras before the wall, which fills their pictures."""
    focal = SIZE * AWAY_M / WIDTH_M
    lens = np.array([[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1]])
    cameras = []
    for number, offset in enumerate(np.linspace(-0.5, 0.5, CAMERAS)):
        pose = np.eye(4)
        angle = np.arctan2(offset, AWAY_M)
        pose[:3, :3] = [
            [np.cos(angle), 0, np.sin(angle)],
            [0, 1, 0],
            [-np.sin(angle), 0, np.cos(angle)],
        ]
        pose[:3, 3] = pose[:3, :3] @ np.array([-offset, 0, AWAY_M])
        cameras.append(Camera(f"c{number}", lens, pose, SIZE, SIZE))
    return Rig(tuple(cameras))


def shown(state: Gaussians, index: int, cameras: Rig) -> Frame:
    """The frame after so many slides."""
    way = np.array([SLIDE_M * index, 0.5 * SLIDE_M * index, 0], np.float32)
    means = state.means + np.where(state.moving[:, None], way, np.float32(0))
    return replace(photograph(state.replace(means=means.astype(np.float32)), cameras), index=index, time=index / RATE)


def measure(shares: Sequence[float], frames: int, settings: Settings | None = None) -> list[MovingTime]:
    """Updates all variants in turns, frame by frame.

    Args:
        shares: 0…1. frames: updates of each; the first one, which looks for the motion, does not count.
    """
    settings = settings or Settings.model_validate({"scene": {"metres_per_unit": 1.0}})
    cameras = rig()
    scenes, states, seconds = [], [], [[] for _ in shares]  # type: ignore[var-annotated]
    for share in shares:
        state = wall(share)
        scene = Reconstruction.start(cameras, shown(state, 0, cameras), settings, static=_known(state, cameras))
        scenes.append(scene)
        states.append(state)
    for index in range(1, frames + 1):
        for number, (scene, state) in enumerate(zip(scenes, states, strict=True)):
            frame = shown(state, index, cameras)
            began = perf_counter()
            scene.step(frame)
            seconds[number].append(perf_counter() - began)
    results = []
    for number, (share, state) in enumerate(zip(shares, states, strict=True)):
        report = scenes[number].report
        assert report is not None
        psnr = float(np.mean([fit["psnr"] for fit in report.cameras.values()]))
        results.append(MovingTime(share, int(state.moving.sum()), float(np.median(seconds[number][1:])), psnr))
    return results


def _known(state: Gaussians, cameras: Rig) -> StaticResult:
    """Frame 0 as it is, in the world of the cameras."""
    world = cameras.world_frame(1.0)
    return StaticResult(state.replace(means=world.to_inside(state.means).astype(np.float32)), {}, [])


def table(results: Sequence[MovingTime]) -> str:
    """The results in Markdown; ratios to the last one."""
    last = results[-1].seconds
    lines = ["| pixels that move | Gaussians that move | s an update | of the last | PSNR |", "|---|---|---|---|---|"]
    lines += [
        f"| {100 * one.share:.0f} % | {one.moving:,} | {one.seconds:.2f} | {one.seconds / last:.2f} | {one.psnr:.1f} |"
        for one in results
    ]
    return "\n".join(lines)
