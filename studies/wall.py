"""Synthetic scene of a textured wall whose middle part slides, with any number of Gaussians and cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scas4d_core.cameras import Camera, Rig
from scas4d_core.captures.frame import Frame
from scas4d_core.engines.cpu.rasterizer import CpuRasterizer
from scas4d_core.engines.views import CameraArrays
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.gaussians import Gaussians

WIDTH_M, AWAY_M, BASELINE_M = 2.0, 3.0, 1.0
"""Width of the wall, distance of the cameras from the wall, and distance between the first and last camera."""
SLIDE_M = 0.008
RATE = 30.0


@dataclass(frozen=True)
class Size:
    """Size of the wall scene.

    Attributes:
        gaussians: approximate number of Gaussians, which form a square grid.
        width: image width in pixels.
        height: image height in pixels.
        cameras: number of cameras.
        moving: fraction of the wall's area that moves.
    """

    gaussians: int = 20_000
    width: int = 256
    height: int = 256
    cameras: int = 12
    moving: float = 0.25


def wall(size: Size) -> Gaussians:
    """Creates the wall's Gaussians in metres, centred at the origin, with the middle part labelled as moving."""
    side = round(size.gaussians**0.5)
    lines = np.linspace(-WIDTH_M / 2, WIDTH_M / 2, side)
    x, y = (axis.ravel() for axis in np.meshgrid(lines, lines))
    rng = np.random.default_rng(5)
    patches = rng.uniform(0.1, 0.9, (50, 50, 3))  # the same texture for any number of Gaussians
    row, column = (np.minimum(((axis / WIDTH_M + 0.5) * 50).astype(int), 49) for axis in (y, x))
    points = np.stack([x, y, 0.01 * rng.standard_normal(len(x))], axis=1)
    gaussians = Gaussians.of_points(points, radius=0.6 * WIDTH_M / side, colours=patches[row, column])
    moves = np.maximum(np.abs(x), np.abs(y)) <= np.sqrt(size.moving) * WIDTH_M / 2 + 1e-9
    return gaussians.replace(foreground=moves.astype(np.float32))


def rig(size: Size) -> Rig:
    """Creates a row of cameras that look at the centre of the wall, which fills the height of their images."""
    focal = size.height * AWAY_M / WIDTH_M
    lens = np.array([[focal, 0, size.width / 2], [0, focal, size.height / 2], [0, 0, 1]])
    cameras = []
    for number, offset in enumerate(np.linspace(-BASELINE_M / 2, BASELINE_M / 2, size.cameras)):
        pose, angle = np.eye(4), np.arctan2(offset, AWAY_M)
        cos, sin = np.cos(angle), np.sin(angle)
        pose[:3, :3] = [[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]
        pose[:3, 3] = pose[:3, :3] @ np.array([-offset, 0, AWAY_M])
        cameras.append(Camera(f"c{number}", lens, pose, size.width, size.height))
    return Rig(tuple(cameras))


def shown(state: Gaussians, index: int, cameras: Rig) -> Frame:
    """Renders frame ``index``, with the middle part shifted by ``index * SLIDE_M`` along x and half as far along y."""
    way = np.array([SLIDE_M * index, 0.5 * SLIDE_M * index, 0], np.float32)
    means = state.means + np.where(state.moving[:, None], way, np.float32(0))
    return replace(photograph(state.replace(means=means.astype(np.float32)), cameras), index=index, time=index / RATE)


def photograph(gaussians: Gaussians, cameras: Rig) -> Frame:
    """Renders the images and masks of all cameras on the CPU and returns them as frame 1 with timestamp 1 s.

    The Gaussians and the cameras must use the same coordinates.
    """
    images, masks = {}, {}
    features = np.concatenate([gaussians.colours, gaussians.foreground[:, None]], axis=1)
    for camera in cameras.cameras:
        picture = CpuRasterizer().forward(
            gaussians.means, gaussians.factors, gaussians.opacities, features, CameraArrays.of(camera),
            np.zeros(4, np.float32),
        )  # fmt: skip
        images[camera.name] = (255 * np.moveaxis(picture.features[:3], 0, -1).clip(0, 1)).round().astype(np.uint8)
        masks[camera.name] = (picture.features[3] > 0.5).astype(np.uint8)
    return Frame(1, 1.0, images, masks)


def known(state: Gaussians, cameras: Rig) -> StaticResult:
    """Returns the ground truth of frame 0 as if it were a fitted result, in the rig's internal coordinates."""
    world = cameras.world_frame(1.0)
    return StaticResult(state.replace(means=world.to_inside(state.means).astype(np.float32)), {}, [])
