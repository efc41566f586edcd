"""Pictures and videos that commands leave: renders beside the truth, written through imageio."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
from numpy.typing import NDArray

from client.importers.extras import pyav
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


def coloured(labels: NDArray[np.uint8]) -> Picture:
    """Labels [H, W], one more than the part's and 0 for none, as [H, W, 3]: the service's colours, black for none."""
    palette = [(0, 0, 0), *(part_colour(label) for label in range(int(labels.max(initial=0))))]
    return np.array(palette, np.uint8)[labels]


def brightness(depth: NDArray[np.floating]) -> Picture:
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


@contextmanager
def video(path: Path, fps: float) -> Iterator[Callable[[Picture], None]]:
    """Writes pictures of one size as a video, H.264 in an MP4, which every browser plays; folders are made.

    Args:
        path: ends in `.mp4`. fps: pictures a second.

    Yields:
        A function that adds a picture, [H, W, 3]; an odd row or column at the end is left out, as the encoding needs.

    Raises:
        MissingExtra: PyAV is not installed.

    >>> with video(out / "grey.mp4", 25) as add:
    ...     for level in range(3):
    ...         add(np.full((16, 32, 3), level, np.uint8))
    """
    pyav()
    path.parent.mkdir(parents=True, exist_ok=True)
    with imageio.imopen(path, "w", plugin="pyav") as file:
        file.init_video_stream("libx264", fps=fps)

        def add(picture: Picture) -> None:
            height, width = (size // 2 * 2 for size in picture.shape[:2])
            file.write_frame(np.ascontiguousarray(picture[:height, :width]))

        yield add
