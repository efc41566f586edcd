"""Estimates of the memory and disk space that a scene needs; `scripts/bench memory` measured the constants."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from pathlib import Path

from client.wire import RigModel, SceneEstimate
from scas4d_core.settings import Settings
from server.problems import Problem, count_noun
from server.settings import ServerSettings

PROCESS = 280e6
"""Bytes of the interpreter, libraries and compiled kernels in a worker or reader process."""
PIXEL = 12
"""Bytes per input pixel: the decoded image and mask of the previous, the current and the next frame."""
SCALED_PIXEL = 112
"""Bytes per scaled pixel for the images of an update.

These are the target image (3 or 4 float32 channels) and the image of the static Gaussians. The box around the moving
Gaussians also has a copy of the target and SSIM's two moments. Without masks, the targets and moments of two frames are
kept.
"""
NOVEL_PIXEL = 38
"""Additional bytes per scaled pixel if Gaussians may be added.

Of these, 21 are for detecting new content in each camera (an image, an error map and five masks). The other 17 are for
the distance maps for carving, or for the image crops to which the new Gaussians are fitted.
"""
VOXELS = 150e6
"""Maximum memory in bytes of the voxels that carve a new object and the grid that separates objects."""
GAUSSIAN = 2200
"""Bytes per Gaussian in the worker: state, deformation layers, Adam moments, neighbors and render buffers."""
READ_GAUSSIAN = 500
"""Bytes per Gaussian in a reader."""
GPU_CONTEXT = 500e6
"""Bytes of GPU memory for the CUDA context and kernels of a process."""
GPU_BASE = 40e6
"""Bytes of GPU memory in the worker that depend neither on the images nor on the Gaussians."""
GPU_PIXEL = 120
"""Bytes of GPU memory per scaled pixel: the training images, SSIM's moments and buffers for the gradients."""
GPU_GAUSSIAN = 4000
"""Bytes of GPU memory per Gaussian in the worker, including frame 0."""
GPU_READ_GAUSSIAN = 1100
"""Bytes of GPU memory per Gaussian in the reader that renders views."""
GPU_VIEW = 125e6
"""Bytes of GPU memory for a view of 1920×1080 pixels in the reader; 60 per pixel."""
STATE = 81
"""Bytes on disk per Gaussian and frame."""
HISTORY = 28
"""Bytes per Gaussian and queried frame: position and material rotation."""
LARGEST_BUDGET, MOST_PER_PIXEL = 100_000, 0.61
"""Limits of `scas4d_core.first_frame.static_scene.budget` for an image without background."""
BEARING = ("entering", "uncovered")
"""Effects that add Gaussians and therefore detect new content in the images."""
SCALES = (0.75, 0.5, 0.35, 0.25, 0.125)
"""Image scales to suggest for a scene that does not fit into memory, in order of preference."""

log = logging.getLogger("scas4d.server")

CGROUP = Path("/sys/fs/cgroup/memory.max")


def machine_mb() -> float:
    """Returns the memory of the machine, or the container's limit if that is lower, in MB."""
    total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        return min(total, int(CGROUP.read_text())) / 1e6
    except (OSError, ValueError):
        return total / 1e6


def estimate(rig: RigModel, settings: Settings, server: ServerSettings, scale: float | None = None) -> SceneEstimate:
    """Returns the memory and disk estimate of a scene; `scale` overrides `scene.image_scale`."""
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
    gpu = 2 * GPU_CONTEXT + GPU_BASE + GPU_VIEW + scaled * GPU_PIXEL + gaussians * (GPU_GAUSSIAN + GPU_READ_GAUSSIAN)
    limit = machine_mb() if server.max_scene_memory_mb is None else server.max_scene_memory_mb
    in_mb = {
        "pictures_mb": pictures,
        "gaussians_mb": gaussians * GAUSSIAN,
        "worker_mb": worker,
        "readers_mb": readers,
        "memory_mb": worker + readers,
        "gpu_mb": 0.0 if settings.device == "cpu" else gpu,
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


def refuse_if_too_large(rig: RigModel, settings: Settings, server: ServerSettings) -> None:
    """Refuses a scene whose estimated memory exceeds the limit.

    Raises:
        Problem: 422 if the scene is refused; the remedy suggests an image scale that fits, if there is one.
    """
    needed = estimate(rig, settings, server)
    if needed.memory_mb <= needed.limit_mb:
        return
    fault = f"the scene needs an estimated {needed.memory_mb:.0f} MB of memory; the limit is {needed.limit_mb:.0f} MB"
    remedy = "raise SCAS4D_MAX_SCENE_MEMORY_MB"
    raise _too_large(rig, settings, server, needed, fault, remedy, lambda it: it.memory_mb <= needed.limit_mb)


def fit_gpu(rig: RigModel, settings: Settings, server: ServerSettings, free_mb: float | None) -> Settings:
    """Returns the settings, with device `cpu` instead of `auto` if the GPU lacks memory for the scene.

    Args:
        rig: rig of the scene.
        settings: settings of the scene.
        server: settings of the service.
        free_mb: free GPU memory in MB, or None if there is no GPU.

    Raises:
        Problem: 422 if the scene requires a GPU whose free memory is too small.
    """
    needed = estimate(rig, settings, server)
    if free_mb is None or needed.gpu_mb <= free_mb:
        return settings
    fault = f"the scene needs an estimated {needed.gpu_mb:.0f} MB of GPU memory; {free_mb:.0f} MB are free"
    if settings.device == "auto":
        log.warning("device 'auto' selects the CPU: %s", fault)
        return settings.model_copy(update={"device": "cpu"})
    remedy = "set settings.device to 'cpu'"
    raise _too_large(rig, settings, server, needed, fault, remedy, lambda it: it.gpu_mb <= free_mb)


def _too_large(
    rig: RigModel,
    settings: Settings,
    server: ServerSettings,
    needed: SceneEstimate,
    fault: str,
    remedy: str,
    fits: Callable[[SceneEstimate], bool],
) -> Problem:
    """Returns the refusal of a scene; the remedy suggests an image scale for which `fits` is true, if there is one."""
    remedy = f"use fewer or smaller images, lower settings.static.max_gaussians, or {remedy}"
    smaller = [scale for scale in SCALES if scale < settings.scene.image_scale]
    scale = next((scale for scale in smaller if fits(estimate(rig, settings, server, scale))), None)
    if scale is not None:
        remedy = f"set settings.scene.image_scale to {scale:g}, or {remedy}"
    return Problem(
        422,
        fault,
        field="rig.cameras",
        value=f"{count_noun(len(rig.cameras), 'camera')}, {needed.scaled_pixels} pixels, {needed.gaussians} Gaussians",
        remedy=remedy,
        estimate=needed.model_dump(),
    )
