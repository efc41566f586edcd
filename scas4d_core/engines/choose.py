"""Selection of the engine for a device. Engines are imported lazily, because their dependencies are optional."""

from __future__ import annotations

import ctypes
import importlib.util
import os
import sys
from functools import cache
from typing import Literal

from scas4d_core.engines.engine import UpdateEngine
from scas4d_core.engines.fit import FitEngine
from scas4d_core.engines.limits import Limits
from scas4d_core.engines.renderer import Renderer

Device = Literal["cpu", "gpu"]

WARP_DEVICE = "SCAS4D_WARP_DEVICE"
"""Environment variable that names the Warp device for device "gpu". Tests set it to "cpu", which runs the same kernels
more slowly but without a GPU."""


class DeviceError(ValueError):
    """Raised if a scene requires a GPU but none can be used.

    Args:
        reason: explanation of why no GPU can be used.

    >>> print(DeviceError("NVIDIA Warp is not installed"))
    device 'gpu' cannot be used: NVIDIA Warp is not installed; see docs/gpu.md, or choose device 'cpu' or 'auto'
    """

    def __init__(self, reason: str) -> None:
        super().__init__(f"device 'gpu' cannot be used: {reason}; see docs/gpu.md, or choose device 'cpu' or 'auto'")


def gpu_fault() -> str | None:
    """Returns the reason why device "gpu" cannot be used, or None if it can."""
    if importlib.util.find_spec("warp") is None:
        return "NVIDIA Warp is not installed (extra gpu)"
    return None if warp_device() == "cpu" else _hardware_fault(warp_device())


@cache
def _hardware_fault(device: str) -> str | None:
    """Returns the reason why no GPU can be used, or None. Imports NVIDIA Warp only if a driver is installed."""
    try:
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return "no NVIDIA driver is installed"
    try:
        import warp

        if warp.get_cuda_device_count() == 0:
            return "no NVIDIA GPU can be used, or the driver is older than the CUDA version of NVIDIA Warp requires"
        warp.get_device(device)
    except Exception as error:  # a broken installation must not stop the service
        return f"NVIDIA Warp cannot use {device!r}: {error}"
    return None


def free_gpu_mb() -> float | None:
    """Returns the free memory of the GPU in MB (10⁶ bytes), or None if device "gpu" is not a GPU."""
    if warp_device() == "cpu" or gpu_fault() is not None:
        return None
    import warp

    return float(warp.get_device(warp_device()).free_memory / 1e6)


def resolve_device(device: Literal["auto", "cpu", "gpu"]) -> Device:
    """Resolves the setting ``device`` to a device.

    "auto" selects the GPU if one can be used, otherwise the CPU. It never selects Warp's CPU device.

    Args:
        device: value of the setting ``device``.

    Raises:
        DeviceError: if the setting requires a GPU but none can be used.

    >>> resolve_device("cpu")
    'cpu'
    """
    if device == "cpu" or (device == "auto" and (warp_device() == "cpu" or gpu_fault() is not None)):
        return "cpu"
    if fault := gpu_fault():
        raise DeviceError(fault)
    return "gpu"


def warp_device() -> str:
    """Returns the name of the Warp device that device "gpu" uses."""
    return os.environ.get(WARP_DEVICE, "cuda:0")


def engine_of(device: Device) -> UpdateEngine:
    """Returns a new update engine for a device.

    >>> engine_of("cpu").name
    'cpu'
    """
    if device == "gpu":
        from scas4d_core.engines.warp.engine import WarpEngine

        return WarpEngine(warp_device())
    from scas4d_core.engines.cpu.engine import CpuEngine

    return CpuEngine()


def renderer_of(device: Device, background: tuple[float, float, float], limits: Limits) -> Renderer:
    """Returns a new full-image renderer for a device.

    Args:
        device: device to use; see ``resolve_device``.
        background: background colour, RGB in [0, 1].
        limits: rasterizer constants.
    """
    if device == "gpu":
        from scas4d_core.engines.warp.renderer import WarpRenderer

        return WarpRenderer(background, limits, warp_device())
    from scas4d_core.engines.cpu.renderer import CpuRenderer

    return CpuRenderer(background, limits=limits)


def fit_engine_of(renderer: Renderer, mask_weight: float = 0.0) -> FitEngine:
    """Returns a new engine for one fit, with its own buffers and the renderer's device, background and limits.

    Args:
        renderer: renderer that determines the device, background and limits.
        mask_weight: weight of the mask loss, which is added to the image loss and only affects the labels.

    Raises:
        TypeError: if there is no fit engine for this type of renderer.
    """
    from scas4d_core.engines.cpu.fit import CpuFitEngine
    from scas4d_core.engines.cpu.renderer import CpuRenderer

    if isinstance(renderer, CpuRenderer):
        return CpuFitEngine(renderer.with_new_buffers(mask_weight))
    from scas4d_core.engines.warp.fit import WarpFitEngine
    from scas4d_core.engines.warp.renderer import WarpRenderer

    if isinstance(renderer, WarpRenderer):
        return WarpFitEngine(renderer, mask_weight)
    raise TypeError(f"no fit engine for a {type(renderer).__name__}")
