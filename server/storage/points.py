"""Readers for the initial point cloud of a scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scas4d_core.storage.npz import read_npz


def points_sha256(path: Path) -> str | None:
    """Returns the SHA-256 of the request body that contained a scene's points.

    Returns None if the scene has no points, and an empty string if the file cannot be read.
    """
    try:
        return bytes(read_npz(path, ("sha256",))["sha256"]).hex()
    except FileNotFoundError:
        return None
    except ValueError:
        return ""


def points_positions(path: Path) -> NDArray[np.float64] | None:
    """Returns the positions [P, 3] of a scene's points, or None if the points are missing or unreadable."""
    try:
        return np.asarray(read_npz(path, ("positions",))["positions"], np.float64)
    except (FileNotFoundError, ValueError):
        return None
