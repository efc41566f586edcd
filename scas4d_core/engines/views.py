"""Training views and cameras in host memory, which each engine uploads to its device."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Camera

Array = NDArray[np.float32]

SIDE = 8
"""Side length, in pixels, of the squares whose mean colours are compared between frames. Averaging reduces noise."""
LABEL = 3
"""Index of the label channel, which follows red, green and blue."""


class CameraArrays(NamedTuple):
    """A camera in the format that kernels expect.

    Attributes:
        pose: [3, 4] float32 world-to-camera transform.
        lens: [6] float32 intrinsics: fx, fy, cx, cy, width, height.
        width, height: image size in pixels.
    """

    pose: Array
    lens: Array
    width: int
    height: int

    @classmethod
    def of(cls, camera: Camera) -> CameraArrays:
        """Converts a ``Camera`` in internal world coordinates."""
        pose = np.ascontiguousarray(camera.world_to_camera[:3], dtype=np.float32)
        lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height], dtype=np.float32)
        return cls(pose, lens, camera.width, camera.height)

    @property
    def centre(self) -> Array:
        """Camera centre [3] in internal world coordinates, in metres."""
        centre: Array = -(self.pose[:, :3].T @ self.pose[:, 3])
        return centre


@dataclass(frozen=True, eq=False)
class TrainingView:
    """The image and optional mask of one camera in one frame.

    Attributes:
        name: name of the camera.
        camera: camera in kernel format.
        target: [C, H, W] float32 image, RGB in [0, 1], followed by the mask if the frame has one. C is 3 or 4.
        exposure: [C, 2] gain and offset of each channel, which are 1 and 0 for the mask.
        source: [H, W, 3] uint8 image and [H, W] uint8 mask (or None) from which ``target`` was converted, if any.
        finer: target [C, h, w] of a larger view that ``target`` was area-averaged from, if any.
        file: image file that the image in ``source`` was decoded from, if known.
    """

    name: str
    camera: CameraArrays
    target: Array
    exposure: Array
    source: tuple[NDArray[np.uint8], NDArray[np.uint8] | None] | None = None
    finer: Array | None = None
    file: bytes | memoryview | None = None

    @property
    def pixels(self) -> NDArray[np.uint8]:
        """Image [H, W, 3] with values in 0…255, which are exact if the view was created from an 8-bit image."""
        if self.source is not None:
            return self.source[0]
        return np.ascontiguousarray(np.moveaxis(np.rint(255 * self.target[:3]).astype(np.uint8), 0, -1))

    def exposed(self, colours: Array) -> Array:
        """Returns a rendering's colours [3, H, W], which may be subsampled, with the camera's exposure applied."""
        exposed: Array = self.exposure[:3, 0, None, None] * colours + self.exposure[:3, 1, None, None]
        return exposed

    @cached_property
    def mean(self) -> NDArray[np.float64]:
        """Mean RGB [3] of the image in [0, 1], computed on first access."""
        return means(self.target[:3])

    @cached_property
    def squares(self) -> Array:
        """Mean colours [h, w, 3] of all complete ``SIDE``-pixel squares of the image, computed on first access."""
        height, width = self.target.shape[1] // SIDE, self.target.shape[2] // SIDE
        part = self.target[:3, : height * SIDE, : width * SIDE]
        columns = part.reshape(3, height, SIDE, width * SIDE).sum(axis=2)  # five times faster with rows first
        sums = columns.reshape(3, height, width, SIDE).sum(axis=3)
        return np.ascontiguousarray(np.moveaxis(sums / np.float32(SIDE * SIDE), 0, -1))


def means(planes: Array) -> NDArray[np.float64]:
    """Returns the mean [C] of each plane [C, H, W]. Rows are summed in float32, which is twice as fast."""
    _, height, width = planes.shape
    result: NDArray[np.float64] = planes.sum(axis=2).sum(axis=1, dtype=np.float64) / (height * width)
    return result
