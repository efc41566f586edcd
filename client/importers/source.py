"""`Source`: a capture to be sent: a rig of pinhole cameras and an encoded picture by frame and camera."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from client.importers.calibration import Calibration
from client.importers.undistort import Undistorter
from scas4d_core.cameras import Rig
from scas4d_core.captures import Capture, CaptureError, InitialPoints, decode_mask
from scas4d_core.rig_checks import pose_warnings

Picture = NDArray[np.uint8]
Encoding = Literal["jpeg", "png"]

JPEG_QUALITY = 95


class Source(Protocol):
    """A capture as a rig would send it: files of pinhole cameras."""

    @property
    def name(self) -> str:
        """Name of the capture, for people."""

    @property
    def rig(self) -> Rig:
        """The cameras, as large as the pictures."""

    @property
    def frame_count(self) -> int:
        """Number of frames T."""

    @property
    def fps(self) -> float:
        """Frames per second."""

    @property
    def points(self) -> InitialPoints | None:
        """A cloud of frame 0, or None."""

    @property
    def remarks(self) -> Sequence[str]:
        """Remarks on the reading, for a person."""

    def time(self, index: int) -> float:
        """Seconds of a frame, rising."""

    def encoded(self, index: int, camera: str) -> bytes:
        """A picture as JPEG, PNG or WebP."""

    def encoded_mask(self, index: int, camera: str) -> bytes | None:
        """A mask as PNG; None where there is none."""


class CaptureSource:
    """A capture that the core reads: its files go as they are."""

    def __init__(self, capture: Capture) -> None:
        self._capture = capture
        self.name = capture.name
        self.rig = capture.full_rig
        self.frame_count = capture.frame_count
        self.fps = capture.fps
        self.points = capture.points
        self.remarks = pose_warnings(self.rig, None if self.points is None else self.points.positions)

    def time(self, index: int) -> float:
        """Seconds since frame 0."""
        return index / self.fps

    def encoded(self, index: int, camera: str) -> bytes:
        """The file."""
        return self._capture.encoded(index, camera)

    def encoded_mask(self, index: int, camera: str) -> bytes | None:
        """The file; None where there is none."""
        return self._capture.encoded_mask(index, camera)


class PictureReader(Protocol):
    """Reads the pictures as the cameras took them, from files or videos."""

    @property
    def frame_count(self) -> int:
        """Number of frames T."""

    @property
    def fps(self) -> float | None:
        """Frames per second, where the pictures say."""

    @property
    def remarks(self) -> Sequence[str]:
        """Remarks on the reading, for a person."""

    def time(self, index: int) -> float | None:
        """Seconds, where the pictures say."""

    def file(self, index: int, camera: str) -> Path | None:
        """The picture's own file, if it has one that the service takes."""

    def decoded(self, index: int, camera: str) -> Picture:
        """Decodes a picture, [H, W, 3]."""


class ImportedSource:
    """Pictures of a calibrated rig, their lenses undone.

    A picture of a straight lens that is a file already goes as it is; every other is encoded anew.

    Args:
        name: for people.
        calibration: of the rig.
        pictures: of all its cameras.
        masks: [T] files by camera, or none.
        fps: frames per second where neither pictures nor calibration say.
        encoding: of pictures that are encoded anew; JPEG has quality 95 and no subsampling.

    Raises:
        CaptureError: a lens cannot be undone.
        MissingExtra: a lens has to be undone and OpenCV is not there.
    """

    def __init__(
        self,
        name: str,
        calibration: Calibration,
        pictures: PictureReader,
        *,
        masks: tuple[Mapping[str, Path], ...] = (),
        fps: float | None = None,
        encoding: Encoding = "jpeg",
    ) -> None:
        self.name = name
        self.points = calibration.points
        self.frame_count = pictures.frame_count
        self.fps = fps or pictures.fps or calibration.fps or 30.0
        self.remarks = [*calibration.remarks, *_suspicions(calibration), *pictures.remarks]
        self._pictures = pictures
        self._masks = masks
        self._encoding = encoding
        self._undistorters = {lens.name: Undistorter(lens) for lens in calibration.cameras}
        self._check_times()

    @cached_property
    def rig(self) -> Rig:
        """Pinhole cameras, as large as the pictures."""
        return Rig(tuple(undistorter.camera for undistorter in self._undistorters.values()))

    def undistorter(self, camera: str) -> Undistorter:
        """The undistorter of a camera's lens."""
        return self._undistorters[camera]

    def time(self, index: int) -> float:
        """Seconds: those of the pictures, else by the frame rate."""
        given = self._pictures.time(index)
        return index / self.fps if given is None else given

    def picture(self, index: int, camera: str) -> Picture:
        """[H, W, 3] as the pinhole camera of the rig would have seen it."""
        return self._undistorters[camera].picture(self._pictures.decoded(index, camera))

    def encoded(self, index: int, camera: str) -> bytes:
        """The file as it is, or the undistorted picture encoded."""
        if self._undistorters[camera].lens.straight:
            file = self._pictures.file(index, camera)
            if file is not None:
                return file.read_bytes()
        return encode(self.picture(index, camera), self._encoding)

    def encoded_mask(self, index: int, camera: str) -> bytes | None:
        """The undistorted mask, as PNG."""
        if not self._masks:
            return None
        undistorter = self._undistorters[camera]
        size = (undistorter.lens.width, undistorter.lens.height)
        mask = 255 * decode_mask(self._masks[index][camera], size=size)
        return encode(undistorter.mask(mask), "png")

    def _check_times(self) -> None:
        before = -np.inf
        for index in range(self.frame_count):
            now = self.time(index)
            if now <= before:
                raise CaptureError(
                    f"{self.name}: frame {index} is at {now:g} s, not after the one before, {before:g} s"
                )
            before = now


def _suspicions(calibration: Calibration) -> list[str]:
    """Remarks on poses that seem to be the wrong way round; a lens's distortion does not matter for that."""
    rig = Rig(tuple(lens.pinhole() for lens in calibration.cameras))
    return pose_warnings(rig, None if calibration.points is None else calibration.points.positions)


def encode(picture: Picture, encoding: Encoding) -> bytes:
    """Encodes a picture or mask as the bytes of a file."""
    file = io.BytesIO()
    image = Image.fromarray(picture)
    if encoding == "png":
        image.save(file, "PNG", compress_level=1)
    else:
        image.save(file, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    return file.getvalue()
