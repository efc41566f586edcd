"""Named settings."""

from __future__ import annotations

from scas4d_core.settings import Settings, UpdateSettings

PRESETS: dict[str, Settings] = {
    "scas4d": Settings(),
    # Per-Gaussian updates with the authors' rates (reference: Dynamic3DGaussians, train.py).
    "dynamic3dgs": Settings(
        update=UpdateSettings(clusters=(), rate_rotation=0.001, rate_scale=0.0, rate_colour=0.0025, momentum=1.0)
    ),
}


def preset(name: str) -> Settings:
    """The settings called ``name``.

    Raises:
        ValueError: no such preset; the message lists those there are.
    """
    if name not in PRESETS:
        raise ValueError(f"preset {name!r} is unknown; choose one of {', '.join(sorted(PRESETS))}")
    return PRESETS[name]
