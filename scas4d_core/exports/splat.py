"""Writes the ``.splat`` format of antimatter15/splat (its ``convert.py`` and ``main.js``).

A file has no header. Each Gaussian has 32 bytes, little-endian: position 3×float32, scale 3×float32
(linear standard deviations), RGBA 4×uint8, rotation 4×uint8 (w, x, y, z) as q·128 + 128. Axes and
unit are the user's, as in the 3DGS ``.ply``. Colour is the component of degree 0, and opacity is
linear. Viewers render a file while it loads, so the largest and most opaque Gaussians come first,
as in ``convert.py``. Row order and ids are lost.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from scas4d_core.cameras import WorldFrame
from scas4d_core.exports.atomic_files import atomic_path
from scas4d_core.exports.cloud import cloud_of
from scas4d_core.gaussians import Gaussians

ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
"""Layout of one Gaussian, 32 bytes."""


def write_splat(path: Path | str, gaussians: Gaussians, world: WorldFrame) -> None:
    """Writes one frame atomically, without its retired Gaussians.

    The quaternions q and −q are equivalent. The one whose component of largest magnitude is
    negative is written, because a byte can represent −1 but not +1.

    Args:
        path: path of the file.
        gaussians: state in the internal world.
        world: transform from the user's world to the internal world.

    Raises:
        InputError: if some Gaussians have non-finite values or no volume, or the file cannot be written.

    >>> from tempfile import TemporaryDirectory
    >>> state = Gaussians.of_points([[0, 0, 2]], radius=0.1, colours=[1, 0, 0])
    >>> with TemporaryDirectory() as folder:
    ...     write_splat(f"{folder}/a.splat", state, WorldFrame(np.zeros(3), metres_per_unit=0.5))
    ...     np.fromfile(f"{folder}/a.splat", ROW)["means"]
    array([[0., 0., 4.]], dtype=float32)
    """
    of = cloud_of(gaussians, world).splats
    order = np.argsort(-np.prod(of.scales, axis=1) * of.opacities, kind="stable")
    rows = np.zeros(len(of), ROW)
    rows["means"], rows["scales"] = of.means[order], of.scales[order]
    rgba = np.concatenate([of.colours, of.opacities[:, None]], axis=1)[order]
    rows["rgba"] = np.clip(np.rint(rgba * 255), 0, 255)
    turns = of.rotations[order]
    largest = np.take_along_axis(turns, np.abs(turns).argmax(axis=1)[:, None], axis=1)
    rows["rotation"] = np.clip(np.rint(turns * np.where(largest > 0, -128, 128) + 128), 0, 255)
    with atomic_path(path) as beside:
        rows.tofile(beside)
