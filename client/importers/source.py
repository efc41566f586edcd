"""Pictures of a calibrated rig as its pinhole cameras would have taken them: the reader behind an imported capture."""

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
from client.importers.undistort import Undistorter
from scas4d_core.cameras import Rig
from scas4d_core.captures import CaptureError, SizeMismatch, decode_mask
from scas4d_core.captures.images import Size, eight_bit_file
from scas4d_core.captures.reader import read_bytes
from scas4d_core.captures.size_mismatch import adapt_intrinsics

Picture = NDArray[np.uint8]
Encoding = Literal["jpeg", "png"]

JPEG_QUALITY = 95


class RawReader(Protocol):
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

    @property
    def sizes(self) -> Mapping[str, Size]:
        """(width, height) of each camera's pictures."""

    def time(self, index: int) -> float | None:
        """Seconds, where the pictures say."""

    def path(self, camera: str) -> Path:
        """The camera's first file, for messages."""

    def file(self, index: int, camera: str) -> Path | None:
        """The picture's own file, if it has one of a kind that the service takes."""

    def decoded(self, index: int, camera: str) -> Picture:
        """Decodes a picture, [H, W, 3]."""


class ImportedPictures:
    """Pictures of a calibrated rig, their lenses undone: a `PictureReader`.

    In a file, a picture of a straight lens goes as it is; every other is encoded anew.

    Args:
        calibration: of the rig, for pictures of the size that `raw` has (`fit_to_pictures`).
        raw: pictures of all its cameras.
        masks: [T] files by camera, or none.
        encoding: of pictures that are encoded anew; JPEG has quality 95 and no subsampling.

    Raises:
        CaptureError: a lens cannot be undone.
        MissingExtraError: a lens has to be undone and OpenCV is not there.
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
        """Pinhole cameras, as large as the pictures."""
        return Rig(tuple(undistorter.camera for undistorter in self._undistorters.values()))

    @property
    def remarks(self) -> tuple[str, ...]:
        """Remarks on the files and the lenses, for a person."""
        lenses = (undistorter.remark for undistorter in self._undistorters.values())
        return (*self._raw.remarks, *(remark for remark in lenses if remark is not None))

    def time(self, index: int) -> float | None:
        """Seconds, where the pictures say."""
        return self._raw.time(index)

    def image(self, index: int, camera: str) -> Picture:
        """[H, W, 3] as the pinhole camera of the rig would have seen it."""
        return self._undistorters[camera].picture(self._raw.decoded(index, camera))

    def has_mask(self, index: int, camera: str) -> bool:
        """True where there is a file."""
        return bool(self._masks) and camera in self._masks[index]

    def mask(self, index: int, camera: str) -> Picture:
        """The undistorted mask, [H, W]."""
        undistorter = self._undistorters[camera]
        size = (undistorter.lens.width, undistorter.lens.height)
        return undistorter.mask(decode_mask(self._masks[index][camera], size=size))

    def encoded_image(self, index: int, camera: str) -> bytes:
        """The file as it is, or the undistorted picture encoded; 16 bits are rounded to 8."""
        if self._undistorters[camera].lens.is_pinhole:
            file = self._raw.file(index, camera)
            if file is not None:
                return eight_bit_file(read_bytes(file), str(file))
        return encode(self.image(index, camera), self._encoding)

    def encoded_mask(self, index: int, camera: str) -> bytes | None:
        """The undistorted mask, as PNG."""
        return encode(255 * self.mask(index, camera), "png") if self.has_mask(index, camera) else None


def fit_to_pictures(
    calibration: Calibration, raw: RawReader, size_mismatch: SizeMismatch | None
) -> tuple[Calibration, list[str]]:
    """The calibration for pictures of the size that they have, and remarks on cameras where that is another.

    Raises:
        CaptureError: pictures of another shape than calibrated, and `size_mismatch` does not say how they came about.
    """
    cameras, remarks = [], []
    for lens in calibration.cameras:
        size = raw.sizes[lens.name]
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
    """Refuses times [T] of frames that do not rise.

    Raises:
        CaptureError: names the frame.
    """
    for index, (before, now) in enumerate(pairwise(times), 1):
        if now <= before:
            raise CaptureError(f"{name}: frame {index} is at {now:g} s, not after the one before, {before:g} s")


def encode(picture: Picture, encoding: Encoding) -> bytes:
    """Encodes a picture or mask as the bytes of a file."""
    if encoding == "png":
        return imageio.imwrite("<bytes>", picture, extension=".png", compress_level=1)
    return imageio.imwrite("<bytes>", picture, extension=".jpg", quality=JPEG_QUALITY, subsampling=0)
