"""The engine of a device. Engines are imported when they are asked for: each brings its own libraries."""

from __future__ import annotations

from scas4d_core.engines.engine import UpdateEngine
from scas4d_core.engines.fit import FitEngine
from scas4d_core.engines.limits import Limits
from scas4d_core.engines.renderer import Renderer


def engine_of(device: str) -> UpdateEngine:
    """A new engine.

    Args:
        device: as in the settings; the only one so far is "cpu".

    Raises:
        ValueError: there is no engine for the device.

    >>> engine_of("cpu").name
    'cpu'
    """
    if device == "cpu":
        from scas4d_core.engines.cpu.engine import CpuEngine

        return CpuEngine()
    raise ValueError(f"device {device!r} has no engine; choose 'cpu'")


def renderer_of(device: str, background: tuple[float, float, float], limits: Limits) -> Renderer:
    """A new renderer of whole pictures.

    Args:
        device: see ``engine_of``. background: RGB in 0…1. limits: constants of the rasterizer.

    Raises:
        ValueError: there is no renderer for the device.
    """
    if device == "cpu":
        from scas4d_core.engines.cpu.renderer import CpuRenderer

        return CpuRenderer(background, limits=limits)
    raise ValueError(f"device {device!r} has no renderer; choose 'cpu'")


def fit_engine_of(renderer: Renderer, mask_weight: float = 0.0) -> FitEngine:
    """A new engine for one fit, with the device, background and limits of a renderer, and buffers of its own.

    Args:
        mask_weight: of the mask loss beside the image loss; it teaches the labels alone.

    Raises:
        ValueError: the device of the renderer has no engine for fits.
    """
    from scas4d_core.engines.cpu.fit import CpuFitEngine
    from scas4d_core.engines.cpu.renderer import CpuRenderer

    if isinstance(renderer, CpuRenderer):
        return CpuFitEngine(renderer.with_new_buffers(mask_weight))
    raise ValueError(f"{type(renderer).__name__} has no engine for fits; choose device 'cpu'")
