"""Training views and their cameras: host-side records, which every engine takes from here to its device."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Camera

Array = NDArray[np.float32]

SIDE = 8
"""Pixels of the side of squares whose mean colours are compared from frame to frame: their noise is small."""
LABEL = 3
"""The label's channel, after red, green and blue."""


class CameraArrays(NamedTuple):
    """A camera as kernels read it: ``pose`` [3, 4] and ``lens`` [6] (fx, fy, cx, cy, width, height), float32."""

    pose: Array
    lens: Array
    width: int
    height: int

    @classmethod
    def of(cls, camera: Camera) -> CameraArrays:
        """From a ``Camera`` of the inside world."""
        pose = np.ascontiguousarray(camera.world_to_camera[:3], dtype=np.float32)
        lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height], dtype=np.float32)
        return cls(pose, lens, camera.width, camera.height)

    @property
    def centre(self) -> Array:
        """[3] metres, the camera's centre in the inside world."""
        centre: Array = -(self.pose[:, :3].T @ self.pose[:, 3])
        return centre


@dataclass(frozen=True, eq=False)
class TrainingView:
    """One camera's pictures of one frame.

    Attributes:
        name: the camera's. camera: as kernels read it.
        target: [C, H, W] float32, RGB in 0…1 and, where the frame has a mask, the mask; C is 3 or 4.
        exposure: [C, 2] gain and offset of the camera; the label's are 1 and 0.
    """

    name: str
    camera: CameraArrays
    target: Array
    exposure: Array

    @cached_property
    def mean(self) -> NDArray[np.float64]:
        """[3] of the picture, RGB in 0…1; made when first asked for."""
        return means(self.target[:3])

    @cached_property
    def squares(self) -> Array:
        """[h, w, 3] mean colours of the picture's whole squares of ``SIDE`` pixels; made when first asked for."""
        height, width = self.target.shape[1] // SIDE, self.target.shape[2] // SIDE
        part = self.target[:3, : height * SIDE, : width * SIDE]
        columns = part.reshape(3, height, SIDE, width * SIDE).sum(axis=2)  # whole rows first: a fifth of the time
        sums = columns.reshape(3, height, width, SIDE).sum(axis=3)
        return np.ascontiguousarray(np.moveaxis(sums / np.float32(SIDE * SIDE), 0, -1))


def means(planes: Array) -> NDArray[np.float64]:
    """[C] mean of each of [C, H, W] planes; summed along rows in float32, which is twice as fast."""
    _, height, width = planes.shape
    result: NDArray[np.float64] = planes.sum(axis=2).sum(axis=1, dtype=np.float64) / (height * width)
    return result
