"""Figures per scene from the paper (SCas4D, TMLR 06/2025), as printed in its tables.

Only scenes with a counterpart among the captures are included: five from FastParticle, and Basketball from Panoptic.
The captures have the same names, but contain different images and motions.
"""

from __future__ import annotations

from collections.abc import Mapping

Figures = Mapping[str, float]
"""Maps each capture to its figure."""

SCENES = ("robot", "spring", "wheel", "pendulums", "cloth", "basketball")


def _scenes(*values: float) -> Figures:
    """Maps the scenes, in the order of ``SCENES``, to figures. The last scene may be missing, as in some tables."""
    return dict(zip(SCENES, values, strict=False))


PSNR_100 = _scenes(29.46, 30.28, 27.95, 30.60, 31.68, 30.25)
PSNR_BASELINE_100 = _scenes(21.28, 23.66, 24.14, 24.98, 21.44, 29.48)
PSNR_BASELINE_2000 = _scenes(30.23, 30.88, 28.59, 31.23, 32.91, 30.01)
SSIM_100 = _scenes(0.96, 0.97, 0.94, 0.97, 0.97, 0.93)
SSIM_BASELINE_100 = _scenes(0.90, 0.93, 0.89, 0.94, 0.92, 0.92)
SSIM_BASELINE_2000 = _scenes(0.97, 0.97, 0.94, 0.97, 0.98, 0.92)
"""PSNR in dB and SSIM, from the table "Online methods rendering results"."""

PSNR_BASELINE_300 = _scenes(27.66, 27.16, 26.67, 29.57, 30.41)
SSIM_BASELINE_300 = _scenes(0.95, 0.95, 0.93, 0.96, 0.97)
"""PSNR in dB and SSIM at equal wall-clock time.

The source is the table "our method trained with 100 iterations per time frame against Dynamic3DGS".
"""

PSNR_LAYERS: Mapping[int, Figures] = {
    1: _scenes(24.56, 26.16, 25.12, 25.94, 27.77),
    2: _scenes(29.48, 30.40, 27.86, 30.54, 31.51),
    3: _scenes(29.46, 30.28, 27.95, 30.60, 31.68),
    4: _scenes(29.39, 30.09, 27.87, 30.38, 31.48),
    5: _scenes(29.17, 30.00, 27.79, 30.36, 31.43),
}
"""PSNR in dB by number of layers K.

The sources are the tables "Ablation study for the number of cluster layers" and "More ablation study".
"""

PSNR_FIRST_LAYER: Mapping[int, Figures] = {
    16: _scenes(29.76, 30.43, 27.97, 30.84, 31.56),
    32: _scenes(29.63, 30.43, 27.91, 30.77, 31.62),
    48: _scenes(29.49, 30.36, 28.00, 30.70, 31.61),
    64: _scenes(29.46, 30.28, 27.95, 30.60, 31.68),
}
"""PSNR in dB by number of clusters N in the first layer.

The source is the table "varying the number of clusters in the first layer".
"""

PSNR_MAX_SCALE_2 = _scenes(15.86, 19.86, 22.42, 18.86, 21.53)
"""PSNR in dB for max_scale 2.0 instead of 0.02, from the table "different values of the max scale constraint"."""

MTE_100 = _scenes(0.80, 0.17, 14.88, 0.50, 0.24, 0.57)
MTE_BASELINE_100 = _scenes(7.84, 2.26, 18.53, 3.51, 2.33, 15.85)
"""2D MTE in % of the image diagonal, with the best candidate within 10 pixels, from the table "2D tracking results"."""
