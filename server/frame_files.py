"""The encoded pictures of one frame in one file, on their way from the door to the worker. No pickle."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

IMAGE, MASK = "image.", "mask."


def write_frame(path: Path, images: Mapping[str, bytes], masks: Mapping[str, bytes]) -> None:
    """Writes an npz with one uint8 array a file; whole at `path` and on disk when this returns, or not there."""
    arrays = {IMAGE + name: np.frombuffer(data, np.uint8) for name, data in images.items()}
    arrays |= {MASK + name: np.frombuffer(data, np.uint8) for name, data in masks.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_suffix(".part")
    with beside.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
        file.flush()
        os.fsync(file.fileno())
    beside.replace(path)


def read_frame(path: Path) -> tuple[dict[str, bytes], dict[str, bytes]]:
    """Images and masks by camera name, encoded."""
    with np.load(path, allow_pickle=False) as file:
        data = {name: file[name].tobytes() for name in file.files}
    images = {name[len(IMAGE) :]: value for name, value in data.items() if name.startswith(IMAGE)}
    masks = {name[len(MASK) :]: value for name, value in data.items() if name.startswith(MASK)}
    return images, masks
