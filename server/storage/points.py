"""Reads the initial cloud of a scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scas4d_core.storage.npz import read_npz


def points_sha256(path: Path) -> str | None:
    """Returns the SHA-256 of the request body that a scene's points arrived in, or None where it has no points."""
    try:
        return bytes(read_npz(path, ("sha256",))["sha256"]).hex()
    except FileNotFoundError:
        return None
    except ValueError:
        return ""


def points_positions(path: Path) -> NDArray[np.float64] | None:
    """Returns the positions [P, 3] of a scene's points, or None where it has none that can be read."""
    try:
        return np.asarray(read_npz(path, ("positions",))["positions"], np.float64)
    except (FileNotFoundError, ValueError):
        return None
