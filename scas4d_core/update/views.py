"""Training views: the pictures that an iteration renders and compares with. CPU buffers, prepared once a frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Rig
from scas4d_core.captures.frame import Frame
from scas4d_core.captures.images import area_average, resize_area
from scas4d_core.kernels import image_loss
from scas4d_core.rasterize.cpu import CameraArrays

Array = NDArray[np.float32]

CHANNELS = 4
"""Red, green, blue, label."""
LABEL = 3
"""The label's channel."""


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


def means(planes: Array) -> NDArray[np.float64]:
    """[C] mean of each of [C, H, W] planes; summed along rows in float32, which is twice as fast."""
    _, height, width = planes.shape
    result: NDArray[np.float64] = planes.sum(axis=2).sum(axis=1, dtype=np.float64) / (height * width)
    return result


class ViewFactory:
    """Makes the training views of each frame of a rig; keeps the cameras and the scratch of the image loss.

    Args:
        rig: the cameras inside. source: the cameras as the pictures come in, where they are to be resized.
    """

    def __init__(self, rig: Rig, source: Rig | None = None) -> None:
        self.rig = rig
        self._source = source
        self._scratch: dict[tuple[int, int, int], Array] = {}

    def scratch(self, channels: int, height: int, width: int) -> Array:
        """Zero-bordered scratch of the image loss, one per size."""
        key = (channels, height, width)
        if key not in self._scratch:
            self._scratch[key] = np.zeros(
                (6, channels, height + 2 * image_loss.REACH, image_loss.stride(width)), np.float32
            )
        return self._scratch[key]

    def scaled(self, frame: Frame) -> Frame:
        """The frame with its pictures of the rig's cameras at the size that those have.

        Raises:
            ValueError: a picture or a mask is not of the size that it should come in.
        """
        if self._source is None:
            return frame
        images, masks = {}, {}
        for camera in self.rig.cameras:
            name, size = camera.name, (camera.width, camera.height)
            if name in frame.images:
                image, mask = pictures_of(frame, name, (self._source[name].width, self._source[name].height))
                images[name] = resize_area(image, size)
                if mask is not None:
                    masks[name] = (resize_area(255 * mask, size) >= 128).astype(np.uint8)
        return Frame(frame.index, frame.time, images, masks)

    def views(self, frame: Frame, exposures: dict[str, Array], use_masks: bool = True) -> list[TrainingView]:
        """The views of a frame, in the rig's order; cameras that the frame lacks are left out.

        Args:
            exposures: [3, 2] gain and offset per camera; a camera that is not named has 1 and 0.

        Raises:
            ValueError: a picture's size is not its camera's, or no camera of the rig is in the frame.
        """
        views = []
        for name in self.rig.names:
            if name not in frame.images:
                continue
            camera = CameraArrays.of(self.rig[name])
            image, mask = pictures_of(frame, name, (camera.width, camera.height), use_masks)
            masked = mask is not None
            target = np.empty((3 + masked, camera.height, camera.width), np.float32)
            np.multiply(np.moveaxis(image, -1, 0), np.float32(1 / 255), out=target[:3])
            if masked:
                target[3] = mask
            exposure = np.tile(np.array([1, 0], np.float32), (3 + masked, 1))
            exposure[:3] = exposures.get(name, exposure[:3])
            views.append(self._view(name, camera, target, exposure))
        if not views:
            raise ValueError(f"frame {frame.index} has none of the rig's cameras ({', '.join(self.rig.names)})")
        return views

    def coarser(self, view: TrainingView, scale: float) -> TrainingView:
        """The view with its pictures resized by area averaging, and the camera that sees them so."""
        camera = self.rig[view.name].scaled(scale)
        target = np.moveaxis(view.target, 0, -1)
        rows, columns = view.camera.height // camera.height, view.camera.width // camera.width
        if (rows * camera.height, columns * camera.width) == (view.camera.height, view.camera.width):
            small = target.reshape(camera.height, rows, camera.width, columns, -1).mean(axis=(1, 3))
        else:
            small = area_average(target.astype(np.float64), (camera.width, camera.height)).astype(np.float32)
        planes = np.ascontiguousarray(np.moveaxis(small, -1, 0))
        return self._view(view.name, CameraArrays.of(camera), planes, view.exposure)

    def retouched(self, view: TrainingView, target: Array) -> TrainingView:
        """The view with other planes [C, H, W] of the same size."""
        return self._view(view.name, view.camera, target, view.exposure)

    def _view(self, name: str, camera: CameraArrays, target: Array, exposure: Array) -> TrainingView:
        return TrainingView(name, camera, target, exposure, self.scratch(*target.shape))


def pictures_of(
    frame: Frame, name: str, size: tuple[int, int], use_masks: bool = True
) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """A camera's picture [H, W, 3] and mask [H, W] (None where there is none), of the size (width, height).

    Raises:
        ValueError: they are of another size.
    """
    width, height = size
    image = frame.images[name]
    mask = frame.masks[name] if use_masks and name in frame.masks else None
    for what, array, shape in (("picture", image, (height, width, 3)), ("mask", mask, (height, width))):
        if array is not None and array.shape != shape:
            raise ValueError(
                f"frame {frame.index}, camera {name!r}: {what} is {'x'.join(map(str, array.shape[1::-1]))} "
                f"(array {array.shape}), the rig says {width}x{height} (array {shape})"
            )
    return image, mask


def view_order(count: int, iterations: int, rng: np.random.Generator) -> Sequence[int]:
    """The view that each iteration trains: a new random order whenever all have been used."""
    rounds = -(-iterations // count)
    order = np.concatenate([rng.permutation(count) for _ in range(rounds)])[:iterations]
    return [int(index) for index in order]
