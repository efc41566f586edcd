"""Creation of training views from a frame: images at the size of the rig's cameras, exposures and masks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Rig
from scas4d_core.captures.frame import Frame
from scas4d_core.captures.images import area_average, resize_area
from scas4d_core.engines.views import CameraArrays, TrainingView
from scas4d_core.kernels.pictures import fill_planes

Array = NDArray[np.float32]


class ViewFactory:
    """Creates the training views of each frame of a rig.

    Args:
        rig: cameras in the internal world.
        source: cameras at the size of the incoming images, or None if the images are not resized.

    Attributes:
        rig: cameras in the internal world.
        posed: cameras with their current poses, which the views use.
    """

    def __init__(self, rig: Rig, source: Rig | None = None) -> None:
        self.rig = self.posed = rig
        self._source = source

    def scaled(self, frame: Frame) -> Frame:
        """Returns the frame with its images resized to the rig's cameras.

        Raises:
            ValueError: if an image or mask does not have the expected size.
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
        """Returns the views of a frame in rig order, without cameras that have no image.

        Args:
            frame: frame with images at the size of the rig's cameras.
            exposures: [3, 2] gain and offset of each camera, keyed by name; 1 and 0 for missing cameras.
            use_masks: whether the views include masks.

        Raises:
            ValueError: if an image or mask does not have its camera's size, or if no camera of the rig has an image.
        """
        views = []
        for name in self.rig.names:
            if name not in frame.images:
                continue
            camera = CameraArrays.of(self.posed[name])
            image, mask = pictures_of(frame, name, (camera.width, camera.height), use_masks)
            channels = 3 if mask is None else 4
            target = np.empty((channels, camera.height, camera.width), np.float32)
            fill_planes(np.ascontiguousarray(image), target)
            if mask is not None:
                target[3] = mask
            exposure = np.tile(np.array([1, 0], np.float32), (channels, 1))
            exposure[:3] = exposures.get(name, exposure[:3])
            views.append(TrainingView(name, camera, target, exposure, (image, mask), file=frame.files.get(name)))
        if not views:
            raise ValueError(
                f"frame {frame.index} has no image of any of the rig's cameras ({', '.join(self.rig.names)})"
            )
        return views

    def coarser(self, view: TrainingView, scale: float) -> TrainingView:
        """Returns the view with its planes and camera scaled by ``scale``, using area averaging."""
        camera = self.posed[view.name].scaled(scale)
        if (2 * camera.width, 2 * camera.height) == (view.camera.width, view.camera.height):  # much faster
            pairs = view.target[:, :, 0::2] + view.target[:, :, 1::2]
            planes = (pairs[:, 0::2] + pairs[:, 1::2]) * np.float32(0.25)
        else:
            target = np.moveaxis(view.target, 0, -1).astype(np.float64)
            small = area_average(target, (camera.width, camera.height)).astype(np.float32)
            planes = np.ascontiguousarray(np.moveaxis(small, -1, 0))
        return TrainingView(view.name, CameraArrays.of(camera), planes, view.exposure, finer=view.target)

    def retouched(self, view: TrainingView, target: Array) -> TrainingView:
        """Returns the view with its planes replaced by ``target`` [C, H, W] of the same size."""
        return TrainingView(view.name, view.camera, target, view.exposure)

    def cropped(self, view: TrainingView, left: int, top: int, right: int, bottom: int) -> TrainingView:
        """Returns the part of a view in a rectangle of pixels, excluding column ``right`` and row ``bottom``."""
        lens = view.camera.lens.copy()
        lens[2:] = lens[2] - left, lens[3] - top, right - left, bottom - top
        camera = view.camera._replace(lens=lens, width=right - left, height=bottom - top)
        target = np.ascontiguousarray(view.target[:, top:bottom, left:right])
        return TrainingView(view.name, camera, target, view.exposure)


def pictures_of(
    frame: Frame, name: str, size: tuple[int, int], use_masks: bool = True
) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """Returns the image [H, W, 3] of a camera, and its mask [H, W] or None.

    Args:
        frame: frame that contains the image.
        name: name of the camera.
        size: expected (width, height).
        use_masks: whether to return the mask.

    Raises:
        ValueError: if the image or the mask has a different size.
    """
    width, height = size
    image = frame.images[name]
    mask = frame.masks[name] if use_masks and name in frame.masks else None
    for what, array, shape in (("image", image, (height, width, 3)), ("mask", mask, (height, width))):
        if array is not None and array.shape != shape:
            raise ValueError(
                f"frame {frame.index}, camera {name!r}: {what} is {'x'.join(map(str, array.shape[1::-1]))} "
                f"(array {array.shape}), but the rig expects {width}x{height} (array {shape})"
            )
    return image, mask
