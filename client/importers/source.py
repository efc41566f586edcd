"""Reader for imported captures, which undistorts the images of a calibrated rig to pinhole images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Literal, Protocol

import imageio.v3 as imageio
import numpy as np
from numpy.typing import NDArray

from client.importers.calibration import Calibration
from client.importers.extras import MissingExtraError, opencv
from client.importers.undistort import Undistorter
from scas4d_core.cameras import Rig
from scas4d_core.captures import CaptureError, SizeMismatch, decode_mask
from scas4d_core.captures.images import Size
from scas4d_core.captures.size_mismatch import adapt_intrinsics
from scas4d_core.errors import exact
from scas4d_core.frame_times import MAX_TIME, ROWS, FrameTime, time_warnings

Picture = NDArray[np.uint8]
Encoding = Literal["jpeg", "png"]

JPEG_QUALITY = 95


class RawReader(Protocol):
    """Reader for the original, distorted images in files or videos."""

    @property
    def frame_count(self) -> int:
        """Number of frames T."""

    @property
    def fps(self) -> float | None:
        """Frames per second, or None if unknown."""

    @property
    def remarks(self) -> Sequence[str]:
        """Messages for the user about how the images were read."""

    @property
    def sizes(self) -> Mapping[str, Size]:
        """(width, height) of the images of each camera that has a readable one, keyed by camera name."""

    def time(self, index: int) -> float | None:
        """Returns the frame's time in seconds, or None if unknown."""

    def path(self, camera: str) -> Path:
        """Returns a file of a camera in `sizes`, for messages."""

    def file(self, index: int, camera: str) -> bytes | None:
        """Returns an image as the contents of an 8-bit JPEG, PNG or WebP file, or None if it has to be encoded.

        Raises:
            ImageError: if the file is missing, cannot be decoded or has another size.
        """

    def decoded(self, index: int, camera: str) -> Picture:
        """Returns the decoded image [H, W, 3] of a camera and frame.

        Raises:
            ImageError, CaptureError: if the image is missing or damaged.
        """


class ImportedPictures:
    """Reader for the undistorted images of a calibrated rig, which implements `PictureReader`.

    Image files of cameras without distortion are passed through unchanged. All other images are re-encoded.

    Args:
        calibration: calibration that matches the image sizes of `raw` (see `fit_to_pictures`).
        raw: reader of the original images of all cameras.
        masks: mask files for each frame [T], keyed by camera name; empty if there are no masks.
        encoding: format of re-encoded images. JPEG uses quality 95 without chroma subsampling.

    Raises:
        CaptureError: if a lens cannot be undistorted.
        MissingExtraError: if a lens has distortion and OpenCV is not installed.
    """

    def __init__(
        self,
        calibration: Calibration,
        raw: RawReader,
        *,
        masks: Sequence[Mapping[str, Path]] = (),
        encoding: Encoding = "jpeg",
    ) -> None:
        self.frame_count = raw.frame_count
        self._raw = raw
        self._masks = masks
        self._encoding = encoding
        self._undistorters = {lens.name: Undistorter(lens) for lens in calibration.cameras}

    @cached_property
    def rig(self) -> Rig:
        """Rig of pinhole cameras at the size of the images."""
        return Rig(tuple(undistorter.camera for undistorter in self._undistorters.values()))

    @property
    def remarks(self) -> tuple[str, ...]:
        """Messages for the user about the files and the lenses."""
        lenses = (undistorter.remark for undistorter in self._undistorters.values())
        return (*self._raw.remarks, *(remark for remark in lenses if remark is not None))

    def time(self, index: int) -> float | None:
        """Returns the frame's time in seconds, or None if unknown."""
        return self._raw.time(index)

    def image(self, index: int, camera: str) -> Picture:
        """Returns the undistorted image [H, W, 3], as seen by the rig's pinhole camera."""
        return self._undistorters[camera].picture(self._raw.decoded(index, camera))

    def has_mask(self, index: int, camera: str) -> bool:
        """Returns whether the image has a mask file."""
        return bool(self._masks) and camera in self._masks[index]

    def mask(self, index: int, camera: str) -> Picture:
        """Returns the undistorted mask [H, W]."""
        undistorter = self._undistorters[camera]
        size = (undistorter.lens.width, undistorter.lens.height)
        return undistorter.mask(decode_mask(self._masks[index][camera], size=size))

    def encoded_image(self, index: int, camera: str) -> bytes:
        """Returns the original image file, or the undistorted image re-encoded, as bytes.

        The original is used if it is a JPEG, PNG or WebP file and the camera has no distortion. 16-bit images are
        converted to 8 bits.
        """
        lens = self._undistorters[camera].lens
        if lens.is_pinhole:
            file = self._raw.file(index, camera)
            if file is not None:
                return file
        return encode(self.image(index, camera), self._encoding)

    def encoded_mask(self, index: int, camera: str) -> bytes | None:
        """Returns the undistorted mask as a PNG file, or None if there is no mask."""
        return encode(255 * self.mask(index, camera), "png") if self.has_mask(index, camera) else None


def fit_to_pictures(
    calibration: Calibration, raw: RawReader, size_mismatch: SizeMismatch | None
) -> tuple[Calibration, list[str]]:
    """Adapts a calibration to the actual size of the images.

    Returns:
        The adapted calibration, and a remark for each camera whose image size differs from the calibrated size.

    Raises:
        CaptureError: if the aspect ratio of an image differs from the calibration, and `size_mismatch` is None.
    """
    cameras, remarks = [], []
    for lens in calibration.cameras:
        size = raw.sizes.get(lens.name)
        if size is None:
            cameras.append(lens)
            continue
        k, remark = adapt_intrinsics(
            lens.intrinsics,
            (lens.width, lens.height),
            size,
            camera=lens.name,
            where=str(raw.path(lens.name)),
            size_mismatch=size_mismatch,
        )
        cameras.append(replace(lens, intrinsics=k, width=size[0], height=size[1]))
        remarks += [] if remark is None else [remark]
    return replace(calibration, cameras=tuple(cameras)), remarks


def check_times(name: str, times: Sequence[float]) -> None:
    """Checks that the frame times [T] are finite and strictly increasing.

    Raises:
        CaptureError: if a time is not within ±`MAX_TIME`, or not later than the previous one. The message names the
            frame.
    """
    for index, now in enumerate(times):
        if not abs(now) <= MAX_TIME:
            raise CaptureError(f"{name}: frame {index} is at {now!r} s; give the times in seconds, or omit them")
    for index, (before, now) in enumerate(pairwise(times), 1):
        if now <= before:
            raise CaptureError(
                f"{name}: frame {index} is at {exact(now)} s, not later than the previous one at {exact(before)} s; "
                "correct the times, or omit them"
            )


def unit_remarks(times: Sequence[float], fps: float) -> list[str]:
    """Returns a remark if the frame times [T] are probably not seconds."""
    frames = [FrameTime(index, time, time) for index, time in enumerate(times[:ROWS])]
    return time_warnings(frames, fps)


def encode(picture: Picture, encoding: Encoding) -> bytes:
    """Encodes an image or mask, and returns the bytes of the image file.

    JPEG files are encoded by OpenCV if it is installed. It releases the interpreter lock, so that the images of several
    cameras are encoded in parallel. Pillow, with the same library below, does not.
    """
    if encoding == "png":
        return imageio.imwrite("<bytes>", picture, extension=".png", compress_level=1)
    try:
        cv2 = opencv()
    except MissingExtraError:
        return imageio.imwrite("<bytes>", picture, extension=".jpg", quality=JPEG_QUALITY, subsampling=0)
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    _, file = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), options)
    return bytes(file)
