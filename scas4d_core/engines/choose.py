"""The engine of a device. Engines are imported when they are asked for: each brings its own libraries."""

from __future__ import annotations

from scas4d_core.engines.engine import UpdateEngine
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
