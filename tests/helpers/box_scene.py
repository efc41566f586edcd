"""A textured box on a plate, seen by six small cameras: the scene of the tests of frame 0, updates and what is read."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import Camera, Rig, WorldFrame, rig_inside
from scas4d_core.captures.frame import Frame
from scas4d_core.engines.cpu.rasterizer import CpuRasterizer
from scas4d_core.engines.views import CameraArrays
from scas4d_core.gaussians import Gaussians

SIDE = 0.4
GRID = 8
MOVING = 6 * GRID * GRID
SIZE = 48
TURN = Rotation.from_rotvec([0.02, 0.08, 0.01])
SHIFT = np.array([0.02, 0.01, -0.015])


def look_at(name: str, centre: Sequence[float], focal: float = 60.0, size: int = SIZE) -> Camera:
    """A camera at ``centre`` that looks at the origin; the world's y is down."""
    eye = np.asarray(centre, dtype=np.float64)
    z = -eye / np.linalg.norm(eye)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = [x, np.cross(z, x), z]
    pose[:3, 3] = -pose[:3, :3] @ eye
    return Camera(name, np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]]), pose, size, size)


def make_rig(distance: float = 1.3) -> Rig:
    """Six cameras around the box, three above and three below; their mean is the origin."""
    cameras = []
    for k in range(6):
        angle, height = 2 * np.pi * k / 6, 0.45 * (-1) ** k
        cameras.append(look_at(f"c{k}", [distance * np.sin(angle), height, distance * np.cos(angle)]))
    return Rig(tuple(cameras))


def held_out_camera() -> Camera:
    """Between the cameras of the rig."""
    return look_at("held", [1.3 * np.sin(0.5), -0.1, 1.3 * np.cos(0.5)])


def surface() -> tuple[np.ndarray, np.ndarray]:
    """Positions [M, 3] on the box's faces and orthonormal axes [M, 3, 3], the last the normal."""
    line = (np.arange(GRID) + 0.5) / GRID - 0.5
    a, b = (array.ravel() for array in np.meshgrid(line, line))
    positions, axes = [], []
    for axis in range(3):
        for side in (-0.5, 0.5):
            face = np.zeros((GRID * GRID, 3))
            face[:, axis], face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = side, a, b
            frame = np.zeros((3, 3))
            frame[(axis + 1) % 3, 0] = frame[(axis + 2) % 3, 1] = frame[axis, 2] = 1
            positions.append(SIDE * face)
            axes.append(np.broadcast_to(frame, (GRID * GRID, 3, 3)))
    return np.concatenate(positions), np.concatenate(axes)


def make_box() -> Gaussians:
    """The box (moving, 384 Gaussians) and the plate beneath (standing, 64), in metres of the inside world."""
    rng = np.random.default_rng(0)
    positions, axes = surface()
    positions = positions + rng.normal(0, 0.003, positions.shape)  # equal depths would swap when anything moves
    line = 1.1 * ((np.arange(8) + 0.5) / 8 - 0.5)
    x, z = (array.ravel() for array in np.meshgrid(line, line))
    plate = np.stack([x, np.full(64, 0.33), z], axis=1)
    factors = np.concatenate([axes * [0.028, 0.028, 0.006], np.tile(np.diag([0.07, 0.01, 0.07]), (64, 1, 1))])
    count = MOVING + 64
    return Gaussians(
        means=np.concatenate([positions, plate]).astype(np.float32),
        factors=factors.astype(np.float32),
        rotations=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        opacities=np.full(count, 0.9, np.float32),
        colours=rng.uniform(0.05, 0.95, (count, 3)).astype(np.float32),
        foreground=np.repeat(np.float32([0.98, 0.02]), [MOVING, 64]),
        ids=np.arange(count, dtype=np.int64),
    )


def moved(box: Gaussians, turn: Rotation = TURN, shift: np.ndarray = SHIFT) -> Gaussians:
    """The box turned about the origin and shifted; the plate stands."""
    means, factors, rotations = box.means.copy(), box.factors.copy(), box.rotations.copy()
    means[:MOVING] = turn.apply(box.means[:MOVING]) + shift
    factors[:MOVING] = turn.as_matrix() @ box.factors[:MOVING]
    before = Rotation.from_quat(np.roll(box.rotations[:MOVING], -1, axis=1))
    rotations[:MOVING] = np.roll((turn * before).as_quat(canonical=True), 1, axis=1)
    return box.replace(means=means, factors=factors.astype(np.float32), rotations=rotations)


def photograph(gaussians: Gaussians, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """The 8-bit picture [H, W, 3] and mask [H, W] that a camera of the inside world takes, on black."""
    features = np.concatenate([gaussians.colours, gaussians.foreground[:, None]], axis=1)
    picture = CpuRasterizer().forward(
        gaussians.means, gaussians.factors, gaussians.opacities, features, CameraArrays.of(camera),
        np.zeros(4, np.float32),
    )  # fmt: skip
    colour = np.moveaxis(picture.features[:3], 0, -1)
    return (255 * colour.clip(0, 1)).round().astype(np.uint8), (picture.features[3] > 0.5).astype(np.uint8)


def take_frame(index: int, time: float, gaussians: Gaussians, rig: Rig, masks: bool = True) -> Frame:
    """What the cameras of a rig of the inside world see."""
    shots = {camera.name: photograph(gaussians, camera) for camera in rig.cameras}
    images = {name: image for name, (image, _) in shots.items()}
    return Frame(index, time, images, {name: mask for name, (_, mask) in shots.items()} if masks else {})


def to_user(rig: Rig, world: WorldFrame) -> Rig:
    """The rig of the inside world as the user knows it."""
    back = WorldFrame(-world.origin * world.metres_per_unit, 1 / world.metres_per_unit)
    return rig_inside(back, rig.cameras)


def dyadic_rig() -> Rig:
    """Eight cameras whose numbers are short binary fractions and whose axes are the world's.

    Sums and differences with shifts that are short too are exact in float64, and so is the mean of eight centres.
    """
    cameras = []
    for k in range(4):
        c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[k]
        rotation = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]], np.float64)
        for side in (-1, 1):
            pose = np.eye(4)
            pose[:3, :3] = rotation
            pose[:3, 3] = (0.25 * side, -0.125 * side, 1.375 + 0.125 * k)
            lens = np.array([[64.0, 0, SIZE / 2], [0, 64, SIZE / 2], [0, 0, 1]])
            cameras.append(Camera(f"{k}{'ab'[side > 0]}", lens, pose, SIZE, SIZE))
    return Rig(tuple(cameras))


RIG = dyadic_rig()
"""Its numbers are short binary fractions: what is exact outside stays exact inside."""
