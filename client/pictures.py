"""Renders beside the truth. Numpy and Pillow only."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

DIFFERENCE_GAIN = 4
"""Differences are this much brighter, or nobody would see them."""
PALETTE = np.array(
    [
        [0, 0, 0],
        [230, 159, 0],
        [86, 180, 233],
        [0, 158, 115],
        [240, 228, 66],
        [0, 114, 178],
        [213, 94, 0],
        [204, 121, 167],
    ],
    dtype=np.uint8,
)
"""Black for nothing, then the colours of Okabe and Ito, told apart also by the colour-blind."""

Picture = NDArray[np.uint8]


def comparison(truth: Picture, render: Picture) -> Picture:
    """Truth | render | difference, [H, 3 W, 3]."""
    difference = np.abs(truth.astype(np.int16) - render.astype(np.int16)) * DIFFERENCE_GAIN
    return np.concatenate([truth, render, np.minimum(difference, 255).astype(np.uint8)], axis=1)


def psnr(truth: Picture, render: Picture) -> float:
    """Peak signal-to-noise ratio in dB over pixels and channels; infinite where there is no difference."""
    error = np.mean(np.square(truth.astype(np.float64) - render))
    return float(10 * np.log10(255**2 / error)) if error > 0 else float("inf")


def coloured(labels: NDArray[np.uint8]) -> Picture:
    """Labels [H, W] as colours [H, W, 3]; 0 is black, and colours repeat from the eighth label."""
    result: Picture = np.where(labels[..., None] > 0, PALETTE[1 + (labels.astype(int) - 1) % 7], PALETTE[0])
    return result


def brightness(depth: NDArray[np.floating]) -> Picture:
    """Depth [H, W] as grey [H, W, 3], near is bright; black where there is none."""
    met = np.isfinite(depth)
    if not met.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    near, far = depth[met].min(), depth[met].max()
    grey = np.where(met, 255 - 200 * (np.where(met, depth, near) - near) / max(far - near, 1e-9), 0)
    return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=-1)


def save(path: Path, picture: Picture) -> Path:
    """As PNG; folders are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(path)
    return path
