"""Named settings."""

from __future__ import annotations

from scas4d_core.settings import Settings, UpdateSettings, Weights

PRESETS: dict[str, Settings] = {
    "scas4d": Settings(),
    # Per-Gaussian updates with the authors' terms, weights and rates (Dynamic3DGaussians, train.py).
    "dynamic3dgs": Settings(
        update=UpdateSettings(
            clusters=(),
            own_start=0.0,
            rate_rotation=0.001,
            rate_scale=0.0,
            rate_end=1.0,
            beta1=0.9,
            beta2=0.999,
            rate_colour_standing=0.0025,
            momentum=1.0,
            cold_start=1.0,
            judge=False,
            still=-1.0,
            weights=Weights(mask=3.0, mask_alone=3.0, isometry=2.0, scale=0.0),
        )
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
