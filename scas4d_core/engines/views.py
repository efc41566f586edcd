"""Host-side records of training views and their cameras, which every engine uploads to its device."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Camera

Array = NDArray[np.float32]

SIDE = 8
"""Side in pixels of the squares whose mean colours are compared between frames; averaging reduces their noise."""
LABEL = 3
"""Index of the label channel, after red, green and blue."""


class CameraArrays(NamedTuple):
    """A camera in kernel format: ``pose`` [3, 4] and ``lens`` [6] (fx, fy, cx, cy, width, height), float32."""

    pose: Array
    lens: Array
    width: int
    height: int

    @classmethod
    def of(cls, camera: Camera) -> CameraArrays:
        """Converts a ``Camera`` of the internal world."""
        pose = np.ascontiguousarray(camera.world_to_camera[:3], dtype=np.float32)
        lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height], dtype=np.float32)
        return cls(pose, lens, camera.width, camera.height)

    @property
    def centre(self) -> Array:
        """[3] metres, the camera centre in the internal world."""
        centre: Array = -(self.pose[:, :3].T @ self.pose[:, 3])
        return centre


@dataclass(frozen=True, eq=False)
class TrainingView:
    """The pictures of one camera in one frame.

    Attributes:
        name: name of the camera. camera: the camera in kernel format.
        target: [C, H, W] float32, RGB in 0…1, followed by the mask if the frame has one; C is 3 or 4.
        exposure: [C, 2] gain and offset of the camera; those of the label are 1 and 0.
    """

    name: str
    camera: CameraArrays
    target: Array
    exposure: Array

    @cached_property
    def mean(self) -> NDArray[np.float64]:
        """[3] mean RGB of the picture, in 0…1; computed on first access."""
        return means(self.target[:3])

    @cached_property
    def squares(self) -> Array:
        """[h, w, 3] mean colours of the picture's complete squares of ``SIDE`` pixels; computed on first access."""
        height, width = self.target.shape[1] // SIDE, self.target.shape[2] // SIDE
        part = self.target[:3, : height * SIDE, : width * SIDE]
        columns = part.reshape(3, height, SIDE, width * SIDE).sum(axis=2)  # rows first: five times faster
        sums = columns.reshape(3, height, width, SIDE).sum(axis=3)
        return np.ascontiguousarray(np.moveaxis(sums / np.float32(SIDE * SIDE), 0, -1))


def means(planes: Array) -> NDArray[np.float64]:
    """Returns the mean [C] of each of the planes [C, H, W]; summing rows in float32 is twice as fast."""
    _, height, width = planes.shape
    result: NDArray[np.float64] = planes.sum(axis=2).sum(axis=1, dtype=np.float64) / (height * width)
    return result
