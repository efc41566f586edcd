"""A capture: pictures of a rig over time. Pictures are decoded when they are read."""

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
from scas4d_core.captures.reader import PictureReader


class LazyPictures(Mapping[str, NDArray[np.uint8]]):
    """Pictures by camera name, decoded anew at every access and not kept: a long capture stays out of memory."""

    def __init__(self, cameras: Collection[str], decode: Callable[[str], NDArray[np.uint8]]) -> None:
        self._cameras = cameras
        self._decode = decode

    def __getitem__(self, camera: str) -> NDArray[np.uint8]:
        if camera not in self._cameras:
            raise KeyError(camera)
        return self._decode(camera)

    def __iter__(self) -> Iterator[str]:
        return iter(self._cameras)

    def __len__(self) -> int:
        return len(self._cameras)


@dataclass(frozen=True, eq=False)
class Capture:
    """A sequence of frames of one rig, with points and ground truth where there are any.

    Attributes:
        name: of the capture's folder.
        full_rig: the training cameras at the size of the pictures.
        full_test_rig: the test cameras at the size of the pictures; None where there are none.
        pictures: reads pictures and masks of all these cameras.
        image_scale: pictures, masks, labels and the cameras of ``rig`` are resized by this.
        fps: frames per second; the time of frame i is i / fps where the pictures have no times of their own.
        points: a cloud of frame 0, or None.
        ground_truth: tracks and parts, or None.
        extent: longest side of the box of the foreground over the sequence, user's units, or None.
        remarks: sentences for a person, on how the files were read.

    >>> from scas4d_core.captures import open_capture
    >>> capture = open_capture("samples/robot")
    >>> frame = capture.frame(2)
    >>> round(frame.time, 4), sorted(frame.masks) == sorted(capture.rig.names)
    (0.0667, True)
    >>> capture.encoded_image(2, "0")[:4]  # the file as it is
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
        """The training cameras, as large as the pictures that `frame` gives."""
        return self.full_rig.scaled(self.image_scale)

    @property
    def test_rig(self) -> Rig | None:
        """The test cameras, as large as the pictures that `test_frame` gives; None where there are none."""
        return None if self.full_test_rig is None else self.full_test_rig.scaled(self.image_scale)

    @property
    def frame_count(self) -> int:
        """T, the number of frames."""
        return self.pictures.frame_count

    def time(self, index: int) -> float:
        """Seconds of a frame: those of its pictures, else by the frame rate."""
        given = self.pictures.time(index)
        return index / self.fps if given is None else given

    def frame(self, index: int) -> Frame:
        """The training pictures and masks of one moment.

        Raises:
            IndexError: no such frame. Reading a picture may raise ImageError.
        """
        return self._frame(index, self.full_rig)

    def test_frame(self, index: int) -> Frame:
        """The test pictures of one moment, and masks where there are any: to measure with, never to train on.

        Raises:
            IndexError: no such frame.
            CaptureError: the capture has no test cameras. Reading a picture may raise ImageError.
        """
        if self.full_test_rig is None:
            raise CaptureError(f"capture {self.name}: has no test cameras; hold some out (--test)")
        return self._frame(index, self.full_test_rig)

    def encoded_image(self, index: int, camera: str) -> bytes:
        """Bytes of a picture's file, at full size whatever ``image_scale``, of a training or test camera.

        Raises:
            IndexError: no such frame.
            KeyError: no such camera.
            CaptureError: the file cannot be read.
        """
        self._check(index)
        return self.pictures.encoded_image(index, camera)

    def encoded_mask(self, index: int, camera: str) -> bytes | None:
        """Bytes of a mask's file, at full size whatever ``image_scale``; None where there is none.

        Raises:
            IndexError: no such frame.
            CaptureError: the file cannot be read.
        """
        self._check(index)
        return self.pictures.encoded_mask(index, camera)

    def scaled(self, image_scale: float) -> Capture:
        """The same capture at another ``image_scale``; pictures come from the same reader."""
        truth = self.ground_truth
        if truth is not None:
            sizes = {name: (full, scaled_size(full, image_scale)) for name, (full, _) in truth.image_size.items()}
            truth = replace(truth, image_size=sizes)
        return replace(self, image_scale=image_scale, ground_truth=truth)

    def with_held_out(self, names: Collection[str]) -> Capture:
        """The same capture with these cameras among the test cameras: measured on, never trained on.

        Raises:
            CaptureError: no such camera, or none is left to train on.
        """
        if not names:
            return self
        others = () if self.full_test_rig is None else self.full_test_rig.cameras
        known = [*self.full_rig.names, *(camera.name for camera in others)]
        unknown = sorted(set(names) - set(known))
        if unknown:
            raise CaptureError(f"test camera {unknown[0]!r} is not one of {', '.join(known)}")
        train = tuple(camera for camera in self.full_rig.cameras if camera.name not in names)
        if not train:
            raise CaptureError("every camera is a test camera; leave some to reconstruct from")
        held = tuple(camera for camera in self.full_rig.cameras if camera.name in names)
        return replace(self, full_rig=Rig(train), full_test_rig=Rig(held + others))

    def with_training_as_test(self, rig: Rig | None = None) -> Capture:
        """The same capture with its training cameras for test cameras: measures how well training pictures are met.

        Args:
            rig: these cameras as a scene has refined them; None: as they are.
        """
        return replace(self, full_test_rig=self.full_rig if rig is None else rig)

    def _check(self, index: int) -> None:
        if not 0 <= index < self.frame_count:
            raise IndexError(f"capture {self.name}: frame {index} is not one of 0…{self.frame_count - 1}")

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
