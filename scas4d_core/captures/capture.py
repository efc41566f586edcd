"""A capture: pictures of a rig over time, on disk. Pictures are decoded when they are read."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Rig
from scas4d_core.captures.files import CaptureError
from scas4d_core.captures.frame import Frame, InitialPoints
from scas4d_core.captures.ground_truth import GroundTruth
from scas4d_core.captures.images import decode_image, decode_mask

Files = Mapping[str, Path]


class LazyPictures(Mapping[str, NDArray[np.uint8]]):
    """Pictures by camera name, decoded anew at every access and not kept: a long capture stays out of memory."""

    def __init__(self, files: Files, decode: Callable[[str, Path], NDArray[np.uint8]]) -> None:
        self._files = files
        self._decode = decode

    def __getitem__(self, camera: str) -> NDArray[np.uint8]:
        return self._decode(camera, self._files[camera])

    def __iter__(self) -> Iterator[str]:
        return iter(self._files)

    def __len__(self) -> int:
        return len(self._files)


@dataclass(frozen=True, eq=False)
class Capture:
    """A sequence of frames of one rig, with points and ground truth where there are any.

    Attributes:
        name: of the capture's folder.
        full_rig: the training cameras at the size of the files.
        full_test_rig: the test cameras at the size of the files; None where there are none.
        image_scale: pictures, masks, labels and the cameras of ``rig`` are resized by this.
        image_files: [T] training pictures by camera name.
        mask_files: [T] training masks by camera name; empty mappings where there are none.
        test_image_files: [T] test pictures by camera name.
        test_mask_files: [T] test masks by camera name, of the test cameras that have any.
        fps: frames per second; the time of frame i is i / fps.
        points: a cloud of frame 0, or None.
        ground_truth: tracks and parts, or None.
        extent: longest side of the box of the foreground over the sequence, user's units, or None.

    >>> from scas4d_core.captures import open_capture
    >>> capture = open_capture("samples/robot")
    >>> frame = capture.frame(2)
    >>> round(frame.time, 4), sorted(frame.masks) == sorted(capture.rig.names)
    (0.0667, True)
    >>> capture.encoded(2, "0")[:4]  # the file as it is
    b'\x89PNG'
    >>> capture.test_rig.names
    ('4', '11')
    """

    name: str
    full_rig: Rig
    full_test_rig: Rig | None
    image_scale: float
    image_files: tuple[Files, ...]
    mask_files: tuple[Files, ...]
    test_image_files: tuple[Files, ...]
    test_mask_files: tuple[Files, ...]
    fps: float = 30.0
    points: InitialPoints | None = None
    ground_truth: GroundTruth | None = None
    extent: float | None = None

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
        return len(self.image_files)

    def frame(self, index: int) -> Frame:
        """The training pictures and masks of one moment.

        Raises:
            IndexError: no such frame. Reading a picture may raise ImageError.
        """
        return self._frame(index, self.full_rig, self.image_files, self.mask_files)

    def test_frame(self, index: int) -> Frame:
        """The test pictures of one moment, and masks where there are any: to measure with, never to train on.

        Raises:
            IndexError: no such frame.
            CaptureError: the capture has no test cameras. Reading a picture may raise ImageError.
        """
        if self.full_test_rig is None:
            raise CaptureError(f"capture {self.name}: has no test cameras (no test_meta.json)")
        return self._frame(index, self.full_test_rig, self.test_image_files, self.test_mask_files)

    def encoded(self, index: int, camera: str) -> bytes:
        """Bytes of a picture's file, at full size whatever ``image_scale``, of a training or test camera.

        Raises:
            IndexError: no such frame.
            KeyError: no such camera.
            CaptureError: the file cannot be read.
        """
        return _read(self._file(index, camera, self.image_files, self.test_image_files))

    def encoded_mask(self, index: int, camera: str) -> bytes | None:
        """Bytes of a mask's file, at full size whatever ``image_scale``; None where there is none.

        Raises:
            IndexError: no such frame.
            CaptureError: the file cannot be read.
        """
        try:
            path = self._file(index, camera, self.mask_files, self.test_mask_files)
        except KeyError:
            return None
        return _read(path)

    def _file(self, index: int, camera: str, *sequences: tuple[Files, ...]) -> Path:
        self._check(index)
        for files in sequences:
            if files and camera in files[index]:
                return files[index][camera]
        raise KeyError(camera)

    def _check(self, index: int) -> None:
        if not 0 <= index < self.frame_count:
            raise IndexError(f"capture {self.name}: frame {index} is not one of 0…{self.frame_count - 1}")

    def _frame(self, index: int, rig: Rig, images: tuple[Files, ...], masks: tuple[Files, ...]) -> Frame:
        self._check(index)
        sizes = {camera.name: (camera.width, camera.height) for camera in rig.cameras}
        scale = self.image_scale
        return Frame(
            index=index,
            time=index / self.fps,
            images=LazyPictures(
                images[index], lambda name, path: decode_image(path, size=sizes[name], image_scale=scale)
            ),
            masks=LazyPictures(masks[index], lambda name, path: decode_mask(path, size=sizes[name], image_scale=scale)),
        )


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as fault:
        raise CaptureError(f"{path}: cannot be read ({fault.strerror})") from fault
