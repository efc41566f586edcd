"""Presets: settings by name."""

from __future__ import annotations

from scas4d_core.settings import LayerRates, Settings, UpdateSettings, Weights

PRESETS: dict[str, Settings] = {
    "scas4d": Settings(),
    # Effort where it is needed (docs/accuracy-and-time.md): the first motion is looked for longer, what follows takes
    # fewer and bolder iterations, none where nothing moved; silhouettes are left to the pictures.
    "adaptive": Settings(
        update=UpdateSettings(
            iterations=50,
            cold_longer=3.0,
            still=0.02,
            layer_rates=(
                LayerRates(rotation=0.044, translation=0.0088, scaling=0.002),
                LayerRates(rotation=0.011, translation=0.0022, scaling=0.002),
                LayerRates(rotation=0.0022, translation=0.00044, scaling=0.002),
            ),
            rate_position=4.8e-4,
            rate_rotation=0.006,
            rate_colour=0.00375,
            beta1=0.7,
            beta2=0.9,
            weights=Weights(mask_alone=0.0),
        )
    ),
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

    >>> preset("adaptive").update.iterations
    50

    Raises:
        ValueError: no such preset; the message lists those there are.
    """
    if name not in PRESETS:
        raise ValueError(f"preset {name!r} is unknown; choose one of {', '.join(sorted(PRESETS))}")
    return PRESETS[name]
