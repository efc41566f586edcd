"""Compiles or loads every kernel that a scene needs, before the first picture comes."""

from __future__ import annotations

import hashlib
import logging
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import numpy as np

from scas4d_core.cameras import Camera, Rig
from scas4d_core.captures import Frame, InitialPoints
from scas4d_core.settings import Settings, UpdateSettings

SIZE, BALL_M = 32, 0.4

log = logging.getLogger("scas4d.kernels")

_settled = False
"""This process has asked for its kernels, or compiles them itself."""


def marker() -> Path | None:
    """The file that says that this version's kernels are in the cache for this target; None where there is none.

    Numba keeps what it compiled by the path of the source, so a checkout elsewhere has a mark of its own.
    """
    import numba
    from llvmlite import binding

    from scas4d_core.kernels import jit  # names the cache's folder

    folder = numba.config.CACHE_DIR  # type: ignore[attr-defined]
    where = hashlib.sha256(str(Path(jit.__file__).parent).encode()).hexdigest()[:8]
    named = numba.config.CPU_NAME  # type: ignore[attr-defined]
    target = f"{named}{numba.config.CPU_FEATURES or ''}" if named else binding.get_host_cpu_name()  # type: ignore[attr-defined]
    return Path(folder) / f"warm-{target}-{where}" if folder else None


def warm_up_elsewhere() -> None:
    """`warm_up` in a process of its own, unless the cache has the kernels already.

    Compiling takes a minute and a few hundred megabytes that the process would keep. A process calls this when it
    starts, before its first ``Reconstruction``; without, kernels are compiled where they are first used. Which process
    compiled a kernel changes no bit of its results.
    """
    global _settled
    if _settled:
        return
    _settled = True
    mark = marker()
    if mark is None or mark.exists():
        return
    # The same sources: they may be where only this process looks.
    program = "import sys; sys.path[:] = sys.argv[1:]; from scas4d_core.warm_up import warm_up; warm_up(anew=False)"
    command = [sys.executable or "python3", "-c", program, *sys.path]
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL).returncode == 0
    except OSError:  # no interpreter to be found from inside another program
        done = False
    if not done:
        log.warning("kernels could not be compiled beforehand; the first frames wait for them")


@contextmanager
def _alone(mark: Path | None) -> Iterator[None]:
    """One process at a time compiles for a target: several would share the cores and do the same."""
    with ExitStack() as stack:
        # Where there is no such lock, or no folder to write to, they compile side by side: as harmless as it is slow.
        with suppress(ImportError, OSError):
            import fcntl

            if mark is not None:
                file = stack.enter_context(mark.with_name(f"{mark.name}.lock").open("w"))
                fcntl.flock(file, fcntl.LOCK_EX)
        yield


def warm_up(*, anew: bool = True) -> None:
    """Reconstructs two frames of a ball, 32x32 pixels and a few dozen iterations, once with masks and once without.

    Kernels are compiled for types, not for sizes: those that this leaves in the cache (`kernels.jit`) serve all scenes.
    A separate covariance has kernels of its own. Processes that do so at a time wait for the first.

    Args:
        anew: also where the cache has the kernels: to have this process load them.
    """
    global _settled
    _settled = True
    mark = marker()
    with _alone(mark):
        if anew or mark is None or not mark.exists():
            _reconstruct_a_ball()
        if mark is not None:
            mark.touch()


def _reconstruct_a_ball() -> None:
    from scas4d_core.reconstruction import Reconstruction

    settings = Settings.model_validate({"static": {"iterations": 30}})
    rig = _rig()
    points = _points()
    for masked, covariance in ((True, "entangled"), (False, "separate")):
        update = settings.update.model_copy(update={"iterations": 4, "covariance": covariance})
        settings = settings.model_copy(update={"update": update})
        reconstruction = Reconstruction.start(rig, _frame(rig, 0, masked), settings, points=points)
        for index in (1, 2):
            reconstruction.step(_frame(rig, index, masked))
        _let_a_layer_rest(update)
        camera = rig.cameras[0]
        reconstruction.render(camera)
        reconstruction.tracks_of_pixels(camera, np.array([[SIZE / 2, SIZE / 2]]), 0, [0, 1])
        reconstruction.parts(2)


def _let_a_layer_rest(settings: UpdateSettings) -> None:
    """It has a kernel of its own, and none of the ball's layers need rest."""
    from scas4d_core.gaussians import Gaussians
    from scas4d_core.structure.hierarchy import build_hierarchy
    from scas4d_core.update.deformation import CpuDeformation, length_bounds

    points = _points()
    ball = Gaussians.of_points(points.positions, radius=0.01, colours=points.colours)
    hierarchy = build_hierarchy(ball.means, np.ones(len(ball), bool), (1, 2), 1)
    bounds = length_bounds(hierarchy, ball)
    deformation = CpuDeformation(hierarchy, None, bounds, settings.cluster_map, settings.covariance)
    deformation.start(ball)
    deformation.rest(1)


def _rig() -> Rig:
    """Six cameras around the ball, at the height of its centre."""
    lens = np.array([[1.2 * SIZE, 0, SIZE / 2], [0, 1.2 * SIZE, SIZE / 2], [0, 0, 1]])
    cameras = []
    for k in range(6):
        c, s = np.cos(np.pi * k / 3), np.sin(np.pi * k / 3)
        pose = np.eye(4)
        pose[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
        pose[2, 3] = 2.0
        cameras.append(Camera(f"c{k}", lens, pose, SIZE, SIZE))
    return Rig(tuple(cameras))


def _frame(rig: Rig, index: int, masked: bool) -> Frame:
    """A ball that moves to the right, pixel by pixel."""
    rows, columns = np.mgrid[:SIZE, :SIZE]
    ball = np.hypot(rows - SIZE / 2, columns - SIZE / 2 - index) < BALL_M / 2.0 * 1.2 * SIZE
    image = np.zeros((SIZE, SIZE, 3), np.uint8)
    image[ball] = np.stack([8 * rows, 8 * columns, rows + columns], -1)[ball]
    names = rig.names
    masks = {name: ball.astype(np.uint8) for name in names} if masked else {}
    return Frame(index, index / 30, {name: image for name in names}, masks)


def _points() -> InitialPoints:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(400, 3))
    positions = BALL_M * normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return InitialPoints(positions, np.full((400, 3), 0.5, np.float32), None)
