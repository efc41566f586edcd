"""Reads the arrays of a glTF file with pygltflib."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
"""Number of columns of each type of accessor."""


def open_gltf(file: Path) -> tuple[Any, Callable[[int], NDArray[np.float64]]]:
    """Returns a document, and a function that returns the values of an accessor, [N] or [N, columns]."""
    from pygltflib import GLTF2

    document = GLTF2().load(str(file))
    blob = document.binary_blob()

    def values(place: int) -> NDArray[np.float64]:
        accessor = document.accessors[place]
        view, width = document.bufferViews[accessor.bufferView], WIDTHS[accessor.type]
        begin = (view.byteOffset or 0) + (accessor.byteOffset or 0)
        numbers = np.frombuffer(blob, "<f4", accessor.count * width, begin).astype(np.float64)
        return numbers.reshape(-1, width) if width > 1 else numbers

    return document, values
