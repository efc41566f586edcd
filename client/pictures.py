"""Images written by the commands: renders next to ground truth, depth maps and part labels."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as imageio
import numpy as np
from numpy.typing import NDArray

from client.wire import part_colour

DIFFERENCE_GAIN = 4
"""Factor by which differences are amplified to make them visible."""

Picture = NDArray[np.uint8]


def eight_bit(colour: NDArray[np.floating]) -> Picture:
    """Converts colours [H, W, 3] in [0, 1] to 8-bit values 0…255; values outside the range are clipped."""
    rounded: Picture = np.rint(255 * np.clip(colour, 0, 1)).astype(np.uint8)
    return rounded


def comparison(truth: Picture, render: Picture) -> Picture:
    """Returns ground truth, render and amplified difference side by side, [H, 3 W, 3]."""
    difference = np.abs(truth.astype(np.int16) - render.astype(np.int16)) * DIFFERENCE_GAIN
    return np.concatenate([truth, render, np.minimum(difference, 255).astype(np.uint8)], axis=1)


def psnr(truth: Picture, render: Picture) -> float:
    """Returns the peak signal-to-noise ratio in dB over all pixels and channels; infinity for identical images."""
    error = np.mean(np.square(truth.astype(np.float64) - render))
    return float(10 * np.log10(255**2 / error)) if error > 0 else float("inf")


def colour_labels(labels: NDArray[np.uint8]) -> Picture:
    """Returns a colour image [H, W, 3] of labels [H, W], where 0 means no part (black) and k means part k − 1."""
    palette = [(0, 0, 0), *(part_colour(label) for label in range(int(labels.max(initial=0))))]
    return np.array(palette, np.uint8)[labels]


def depth_to_grey(depth: NDArray[np.floating]) -> Picture:
    """Returns depth [H, W] as a grayscale image [H, W, 3]: near is bright, and pixels without depth are black."""
    met = np.isfinite(depth)
    if not met.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    near, far = depth[met].min(), depth[met].max()
    grey = np.where(met, 255 - 200 * (np.where(met, depth, near) - near) / max(far - near, 1e-9), 0)
    return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=-1)


def save(path: Path, picture: Picture) -> Path:
    """Saves an image, creating missing folders, and returns its path; the suffix determines the format."""
    path.parent.mkdir(parents=True, exist_ok=True)
    imageio.imwrite(path, picture)
    return path
