"""Peak memory of a reconstruction compared with the service's estimate (server/health/estimate.py).

The scene is a ball in the middle of a ring of cameras. Frame 0 and two updates are reconstructed with few iterations,
because memory does not depend on their number.
"""

from __future__ import annotations

import numpy as np

from client.cli.evaluate import peak_megabytes
from client.wire import RigModel
from scas4d_core.cameras import Camera, Rig
from scas4d_core.captures import Frame, InitialPoints
from scas4d_core.presets import preset
from server.health.estimate import estimate
from server.settings import ServerSettings
from studies.constants import varied


def ring(count: int, size: int) -> Rig:
    """Creates a ring of cameras with square images, 2 m from the origin."""
    lens = np.array([[1.2 * size, 0, size / 2], [0, 1.2 * size, size / 2], [0, 0, 1]])
    cameras = []
    for k in range(count):
        c, s = np.cos(2 * np.pi * k / count), np.sin(2 * np.pi * k / count)
        pose = np.eye(4)
        pose[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
        pose[2, 3] = 2.0
        cameras.append(Camera(f"c{k}", lens, pose, size, size))
    return Rig(tuple(cameras))


def frame(rig: Rig, size: int, index: int, masked: bool) -> Frame:
    """Creates a frame that shows a ball, which moves by one pixel per frame."""
    rows, columns = np.mgrid[:size, :size]
    ball = np.hypot(rows - size / 2, columns - size / 2 - index) < 0.24 * size
    picture = np.zeros((size, size, 3), np.uint8)
    picture[ball] = (np.stack([rows, columns, rows + columns], -1)[ball] % 256).astype(np.uint8)
    images = {name: picture.copy() for name in rig.names}
    return Frame(index, index / 30, images, {name: ball.astype(np.uint8) for name in rig.names} if masked else {})


def measure(cameras: int, size: int, gaussians: int, scale: float, masks: bool) -> dict[str, float]:
    """Returns the measured and estimated peak memory in MB, their ratio, and the number of Gaussians."""
    from scas4d_core.reconstruction import Reconstruction
    from scas4d_core.warm_up import compile_in_processes

    compile_in_processes()  # or the compilers would count
    static = {"iterations": 8, "max_gaussians": gaussians}
    settings = preset("scas4d", {"static": static, "update": {"iterations": 4}, "scene": {"image_scale": scale}})
    rig = ring(cameras, size)
    normals = np.random.default_rng(0).normal(size=(gaussians, 3))
    points = 0.4 * normals / np.linalg.norm(normals, axis=1, keepdims=True)
    cloud = InitialPoints(points, np.full((gaussians, 3), 0.5, np.float32), None)
    first = frame(rig, size, 0, masks)
    static_scene = "scas4d_core.first_frame.static_scene"
    with varied(f"{static_scene}.INITIAL_SHARE", 1.0), varied(f"{static_scene}.MIN_VIEWS", 0):
        reconstruction = Reconstruction.start(rig, first, settings, points=cloud)  # keeps every requested Gaussian
    for index in (1, 2):
        reconstruction.step(frame(rig, size, index, masks))
    peak = peak_megabytes() or float("nan")
    expected = estimate(RigModel.of(rig), settings, ServerSettings()).worker_mb
    kept = len(reconstruction.history.gaussians(0))
    return {"peak_mb": round(peak), "estimate_mb": round(expected), "ratio": peak / expected, "kept": kept}
