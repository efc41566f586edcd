"""Training views hold the pictures of a frame in CPU buffers, prepared once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scas4d_core.kernels import image_loss
from scas4d_core.rasterize.cpu import CameraArrays

Array = NDArray[np.float32]

SIDE = 8
"""Pixels of the side of squares whose mean colours are compared from frame to frame: their noise is small."""


@dataclass(frozen=True, eq=False)
class TrainingView:
    """One camera's pictures of one frame.

    Attributes:
        name: the camera's. camera: as kernels read it.
        target: [C, H, W] float32, RGB in 0…1 and, where the frame has a mask, the mask; C is 3 or 4.
        exposure: [C, 2] gain and offset of the camera; the label's are 1 and 0.
        scratch: of the image loss, for pictures of this size.
    """

    name: str
    camera: CameraArrays
    target: Array
    exposure: Array
    scratch: Array

    @cached_property
    def moments(self) -> tuple[Array, Array]:
        """[C, H, W] twice: SSIM's windowed means of the target and of its square; made when first asked for."""
        means, squares = np.empty_like(self.target), np.empty_like(self.target)
        image_loss.target_moments(self.target, self.scratch, means, squares)
        return means, squares

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
