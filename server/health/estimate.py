"""Estimates the memory and disk of a scene; the constants were measured by `scripts/bench memory`."""

from __future__ import annotations

import os
from pathlib import Path

from client.wire import RigModel
from client.wire.estimate import SceneEstimate
from scas4d_core.settings import Settings
from server.problems import Problem, counted
from server.settings import ServerSettings

PROCESS = 280e6
"""Interpreter, libraries and compiled kernels of a process that reconstructs or reads."""
PIXEL = 8
"""Bytes for each pixel as it is sent: decoded with its mask, of the frame at work and the one before."""
SCALED_PIXEL = 112
"""Bytes for each pixel after scaling: 3 or 4 channels of float32 in the target, the same and SSIM's two moments in the
box around what moves, what stands alone; where there are no masks, targets and moments of two frames."""
NOVEL_PIXEL = 38
"""Bytes for each pixel after scaling where Gaussians may be born: what each camera says is new there (a picture, an
error, five masks: 21), the distances to it in carving, or the parts of pictures that the born are fitted to (17)."""
VOXELS = 150e6
"""Bytes of the voxels in which a new thing is carved, and of the grid that separates objects, at their most."""
GAUSSIAN = 2200
"""Bytes for each Gaussian in the worker: state, layers, Adam, neighbours, and what a render needs."""
READ_GAUSSIAN = 500
"""Bytes for each Gaussian in a reader."""
STATE = 81
"""Bytes on disk for each Gaussian and frame."""
HISTORY = 28
"""Bytes for each Gaussian and frame of a query: position and material rotation."""
LARGEST_BUDGET, MOST_PER_PIXEL = 100_000, 0.61
"""Limits of `scas4d_core.first_frame.static_scene.budget`, for a picture without background."""
BEARING = ("entering", "uncovered")
"""Effects by which Gaussians are born, and which ask the cameras what is new."""
SCALES = (0.75, 0.5, 0.35, 0.25, 0.125)

CGROUP = Path("/sys/fs/cgroup/memory.max")


def machine_mb() -> float:
    """Returns the memory of the machine, or of the container if that is less."""
    total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        return min(total, int(CGROUP.read_text())) / 1e6
    except (OSError, ValueError):
        return total / 1e6


def estimate(rig: RigModel, settings: Settings, server: ServerSettings, scale: float | None = None) -> SceneEstimate:
    """Estimates a scene with this rig and these settings; `scale` takes the place of their image_scale."""
    scale = settings.scene.image_scale if scale is None else scale
    sizes = [camera.width * camera.height for camera in rig.cameras]
    pixels = sum(sizes)
    scaled = round(pixels * scale * scale)
    most = max(1, round(MOST_PER_PIXEL * scaled / len(sizes)))
    gaussians = settings.static.max_gaussians or max(1, round(min(LARGEST_BUDGET, most) * settings.static.detail))
    bears = any(settings.effects.get(name) != "off" for name in BEARING)
    pictures = pixels * PIXEL + scaled * (SCALED_PIXEL + NOVEL_PIXEL * bears)
    worker = PROCESS + pictures + gaussians * GAUSSIAN + VOXELS * bears
    readers = 2 * (PROCESS + gaussians * READ_GAUSSIAN)
    limit = machine_mb() if server.max_scene_memory_mb is None else server.max_scene_memory_mb
    in_mb = {
        "pictures_mb": pictures,
        "gaussians_mb": gaussians * GAUSSIAN,
        "worker_mb": worker,
        "readers_mb": readers,
        "memory_mb": worker + readers,
        "state_mb": gaussians * STATE,
        "history_mb": gaussians * HISTORY,
    }
    return SceneEstimate(
        pixels=pixels,
        scaled_pixels=scaled,
        gaussians=gaussians,
        limit_mb=round(limit, 1),
        **{name: round(value / 1e6, 3) for name, value in in_mb.items()},
    )


def check(rig: RigModel, settings: Settings, server: ServerSettings) -> None:
    """Refuses a scene that will not fit.

    Raises:
        Problem: 422, with the scale of the pictures that would.
    """
    needed = estimate(rig, settings, server)
    if needed.memory_mb <= needed.limit_mb:
        return
    smaller = [scale for scale in SCALES if scale < settings.scene.image_scale]
    fits = next((s for s in smaller if estimate(rig, settings, server, s).memory_mb <= needed.limit_mb), None)
    remedy = "send fewer or smaller pictures, lower settings.static.max_gaussians, or raise SCAS4D_MAX_SCENE_MEMORY_MB"
    if fits is not None:
        remedy = f"set settings.scene.image_scale to {fits:g}; or {remedy}"
    raise Problem(
        422,
        f"the scene is estimated to take {needed.memory_mb:.0f} MB, more than {needed.limit_mb:.0f} MB",
        field="rig.cameras",
        value=f"{counted(len(rig.cameras), 'camera')}, {needed.scaled_pixels} pixels, {needed.gaussians} Gaussians",
        remedy=remedy,
        estimate=needed.model_dump(),
    )
