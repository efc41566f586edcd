"""Pictures that commands leave: renders beside the truth, written through imageio."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as imageio
import numpy as np
from numpy.typing import NDArray

from client.wire import part_colour

DIFFERENCE_GAIN = 4
"""Differences are this much brighter, or nobody would see them."""

Picture = NDArray[np.uint8]


def eight_bit(colour: NDArray[np.floating]) -> Picture:
    """Colour in 0…1, [H, W, 3], rounded to 0…255; what lies outside is clipped."""
    rounded: Picture = np.rint(255 * np.clip(colour, 0, 1)).astype(np.uint8)
    return rounded


def comparison(truth: Picture, render: Picture) -> Picture:
    """Truth | render | difference, [H, 3 W, 3]."""
    difference = np.abs(truth.astype(np.int16) - render.astype(np.int16)) * DIFFERENCE_GAIN
    return np.concatenate([truth, render, np.minimum(difference, 255).astype(np.uint8)], axis=1)


def psnr(truth: Picture, render: Picture) -> float:
    """Peak signal-to-noise ratio in dB over pixels and channels; infinite where there is no difference."""
    error = np.mean(np.square(truth.astype(np.float64) - render))
    return float(10 * np.log10(255**2 / error)) if error > 0 else float("inf")


def colour_labels(labels: NDArray[np.uint8]) -> Picture:
    """Labels [H, W], one more than the part's and 0 for none, as [H, W, 3]: the service's colours, black for none."""
    palette = [(0, 0, 0), *(part_colour(label) for label in range(int(labels.max(initial=0))))]
    return np.array(palette, np.uint8)[labels]


def depth_to_grey(depth: NDArray[np.floating]) -> Picture:
    """Depth [H, W] as grey [H, W, 3], near is bright; black where there is none."""
    met = np.isfinite(depth)
    if not met.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    near, far = depth[met].min(), depth[met].max()
    grey = np.where(met, 255 - 200 * (np.where(met, depth, near) - near) / max(far - near, 1e-9), 0)
    return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=-1)


def save(path: Path, picture: Picture) -> Path:
    """Saves a picture as PNG; folders are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    imageio.imwrite(path, picture)
    return path
