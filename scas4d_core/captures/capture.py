"""`Capture`, a sequence of frames from one camera rig. Images are decoded lazily, on access."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Rig
from scas4d_core.captures.files import CaptureError
from scas4d_core.captures.frame import Frame, InitialPoints
from scas4d_core.captures.ground_truth import GroundTruth
from scas4d_core.captures.images import resize_area, resize_mask, scaled_size
from scas4d_core.captures.picture_file import ImageError
from scas4d_core.captures.reader import PictureReader


class LazyPictures(Mapping[str, NDArray[np.uint8]]):
    """Read-only mapping from camera names to images or masks.

    An image is decoded on every access and never cached, to limit memory use.

    Args:
        cameras: names of the cameras.
        decode: function that decodes the image of a camera.
    """

    def __init__(self, cameras: Collection[str], decode: Callable[[str], NDArray[np.uint8]]) -> None:
        self._cameras = cameras
        self._decode = decode

    def __getitem__(self, camera: str) -> NDArray[np.uint8]:
        if camera not in self._cameras:
            raise KeyError(camera)
        return self._decode(camera)

    def __contains__(self, camera: object) -> bool:  # the inherited method would decode the image
        return camera in self._cameras

    def __iter__(self) -> Iterator[str]:
        return iter(self._cameras)

    def __len__(self) -> int:
        return len(self._cameras)


@dataclass(frozen=True, eq=False)
class Capture:
    """A sequence of frames from one rig, optionally with a point cloud and ground truth.

    Attributes:
        name: name of the capture folder.
        full_rig: training cameras at the full image size.
        full_test_rig: test cameras at the full image size, or None.
        pictures: reader for the images and masks of all cameras.
        image_scale: factor by which images, masks, labels and the cameras of ``rig`` and
            ``test_rig`` are scaled.
        fps: frames per second; the time of frame i is i / fps if the images have no timestamps.
        points: point cloud of frame 0, or None.
        ground_truth: ground-truth tracks and parts, or None.
        extent: longest side of the foreground's bounding box over all frames, in the user's units,
            or None if unknown.
        remarks: notes for the user on how the files were read.

    >>> from scas4d_core.captures import open_capture
    >>> capture = open_capture("samples/robot")
    >>> frame = capture.frame(2)
    >>> round(frame.time, 4), sorted(frame.masks) == sorted(capture.rig.names)
    (0.0667, True)
    >>> capture.encoded_image(2, "0")[:4]  # the unchanged file
    b'\x89PNG'
    >>> capture.test_rig.names
    ('4', '11')
    >>> capture.with_held_out(["3"]).test_rig.names
    ('3', '4', '11')
    """

    name: str
    full_rig: Rig
    full_test_rig: Rig | None
    pictures: PictureReader
    image_scale: float = 1.0
    fps: float = 30.0
    points: InitialPoints | None = None
    ground_truth: GroundTruth | None = None
    extent: float | None = None
    remarks: tuple[str, ...] = ()

    @property
    def rig(self) -> Rig:
        """Training cameras at the size of the images that `frame` returns."""
        return self.full_rig.scaled(self.image_scale)

    @property
    def test_rig(self) -> Rig | None:
        """Test cameras at the size of the images that `test_frame` returns, or None."""
        return None if self.full_test_rig is None else self.full_test_rig.scaled(self.image_scale)

    @property
    def frame_count(self) -> int:
        """Number of frames T."""
        return self.pictures.frame_count

    def time(self, index: int) -> float:
        """Returns the time of a frame in seconds: its timestamp, or index / fps if it has none."""
        given = self.pictures.time(index)
        return index / self.fps if given is None else given

    def frame(self, index: int) -> Frame:
        """Returns the training images and masks of one frame.

        Raises:
            IndexError: if the frame does not exist. A later access to an image of the frame may
                raise ImageError.
        """
        return self._frame(index, self.full_rig)

    def usable_frame(self, index: int) -> tuple[Frame, dict[str, str]]:
        """Returns one frame with the training cameras whose image and mask can be used.

        Returns:
            The frame with decoded images and masks, and the reason for each camera that was left
            out, keyed by camera name. The reason names the file.

        Raises:
            IndexError: if the frame does not exist.
        """
        frame = self.frame(index)
        images, masks, left_out = {}, {}, {}
        for name in frame.images:
            try:
                image = frame.images[name]
                if name in frame.masks:
                    masks[name] = frame.masks[name]
            except (ImageError, CaptureError) as fault:
                left_out[name] = str(fault)
            else:
                images[name] = image
        return replace(frame, images=images, masks=masks), left_out

    def test_frame(self, index: int) -> Frame:
        """Returns the test images of one frame, and their masks if available.

        Test images must only be used for evaluation.

        Raises:
            IndexError: if the frame does not exist. A later access to an image of the frame may
                raise ImageError.
            CaptureError: if the capture has no test cameras.
        """
        if self.full_test_rig is None:
            raise CaptureError(f"capture {self.name} has no test cameras; hold some out with --test")
        return self._frame(index, self.full_test_rig)

    def encoded_image(self, index: int, camera: str) -> bytes:
        """Returns the image file of a training or test camera, as bytes.

        The image has its full size, regardless of ``image_scale``.

        Raises:
            IndexError: if the frame does not exist.
            KeyError: if the camera does not exist.
            ImageError, CaptureError: if the file is missing, or is not an image of the camera's size.
        """
        self._check(index)
        return self.pictures.encoded_image(index, camera)

    def encoded_mask(self, index: int, camera: str) -> bytes | None:
        """Returns the mask file of a training or test camera as bytes, or None if it has no mask.

        The mask has its full size, regardless of ``image_scale``.

        Raises:
            IndexError: if the frame does not exist.
            ImageError, CaptureError: if the file is missing, or is not a mask of the camera's size.
        """
        self._check(index)
        return self.pictures.encoded_mask(index, camera)

    def scaled(self, image_scale: float) -> Capture:
        """Returns a copy of the capture with another ``image_scale`` and the same image reader."""
        truth = self.ground_truth
        if truth is not None:
            sizes = {name: (full, scaled_size(full, image_scale)) for name, (full, _) in truth.image_size.items()}
            truth = replace(truth, image_size=sizes)
        return replace(self, image_scale=image_scale, ground_truth=truth)

    def with_held_out(self, names: Collection[str]) -> Capture:
        """Returns a copy of the capture in which the named cameras are test cameras.

        Cameras that already are test cameras remain test cameras.

        Raises:
            CaptureError: if a camera does not exist, or no training camera would be left.
        """
        if not names:
            return self
        others = () if self.full_test_rig is None else self.full_test_rig.cameras
        known = [*self.full_rig.names, *(camera.name for camera in others)]
        unknown = sorted(set(names) - set(known))
        if unknown:
            raise CaptureError(f"unknown test camera {unknown[0]!r}; choose from {', '.join(known)}")
        train = tuple(camera for camera in self.full_rig.cameras if camera.name not in names)
        if not train:
            raise CaptureError("all cameras are test cameras; leave at least one for training")
        held = tuple(camera for camera in self.full_rig.cameras if camera.name in names)
        return replace(self, full_rig=Rig(train), full_test_rig=Rig(held + others))

    def with_training_as_test(self, rig: Rig | None = None) -> Capture:
        """Returns a copy of the capture whose test cameras are the training cameras.

        An evaluation of this copy measures the fit to the training images.

        Args:
            rig: training cameras as refined by a scene, at the full image size, or None to use the
                cameras of the capture.
        """
        return replace(self, full_test_rig=self.full_rig if rig is None else rig)

    def _check(self, index: int) -> None:
        if not 0 <= index < self.frame_count:
            raise IndexError(f"capture {self.name}: frame {index} is out of range 0…{self.frame_count - 1}")

    def _frame(self, index: int, rig: Rig) -> Frame:
        self._check(index)
        scaled, pictures = rig.scaled(self.image_scale), self.pictures
        sizes = {camera.name: (camera.width, camera.height) for camera in scaled.cameras}
        return Frame(
            index=index,
            time=self.time(index),
            images=LazyPictures(rig.names, lambda name: resize_area(pictures.image(index, name), sizes[name])),
            masks=LazyPictures(
                [name for name in rig.names if pictures.has_mask(index, name)],
                lambda name: resize_mask(pictures.mask(index, name), sizes[name]),
            ),
        )
