"""Selection of the engine for a device. Engines are imported lazily, because each one needs its own libraries."""

from __future__ import annotations

from scas4d_core.engines.engine import UpdateEngine
from scas4d_core.engines.fit import FitEngine
from scas4d_core.engines.limits import Limits
from scas4d_core.engines.renderer import Renderer


def engine_of(device: str) -> UpdateEngine:
    """Returns a new update engine for a device.

    Args:
        device: device name from the settings; only "cpu" is supported so far.

    Raises:
        ValueError: if no engine supports the device.

    >>> engine_of("cpu").name
    'cpu'
    """
    if device == "cpu":
        from scas4d_core.engines.cpu.engine import CpuEngine

        return CpuEngine()
    raise ValueError(f"device {device!r} has no engine; choose 'cpu'")


def renderer_of(device: str, background: tuple[float, float, float], limits: Limits) -> Renderer:
    """Returns a new full-image renderer for a device.

    Args:
        device: see ``engine_of``. background: RGB in 0…1. limits: constants of the rasterizer.

    Raises:
        ValueError: if no renderer supports the device.
    """
    if device == "cpu":
        from scas4d_core.engines.cpu.renderer import CpuRenderer

        return CpuRenderer(background, limits=limits)
    raise ValueError(f"device {device!r} has no renderer; choose 'cpu'")


def fit_engine_of(renderer: Renderer, mask_weight: float = 0.0) -> FitEngine:
    """Returns a new engine for one fit, with the renderer's device, background and limits but its own buffers.

    Args:
        mask_weight: weight of the mask loss, which is added to the image loss and only affects the labels.

    Raises:
        ValueError: if the renderer's device has no engine for fits.
    """
    from scas4d_core.engines.cpu.fit import CpuFitEngine
    from scas4d_core.engines.cpu.renderer import CpuRenderer

    if isinstance(renderer, CpuRenderer):
        return CpuFitEngine(renderer.with_new_buffers(mask_weight))
    raise ValueError(f"{type(renderer).__name__} has no engine for fits; choose device 'cpu'")
