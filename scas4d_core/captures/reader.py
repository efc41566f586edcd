"""`PictureReader`, the interface for reading the images of a capture, and `FileReader`.

This module requires only NumPy and Pillow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from scas4d_core.captures.files import CaptureError
from scas4d_core.captures.images import Size, decode_image, decode_mask, eight_bit_file

Files = Mapping[str, Path]


class PictureReader(Protocol):
    """Interface for reading the images and masks of the training and test cameras of a capture.

    All cameras are pinhole cameras, so a reader removes lens distortion. An image has the full size
    of its camera, regardless of the `image_scale` of the capture. A reader keeps at most a few
    images per camera in memory.
    """

    @property
    def frame_count(self) -> int:
        """Number of frames T."""

    def time(self, index: int) -> float | None:
        """Returns the timestamp of a frame in seconds, or None if only the frame rate is known.

        Timestamps are strictly increasing.
        """

    def image(self, index: int, camera: str) -> NDArray[np.uint8]:
        """Returns a decoded image, [H, W, 3] sRGB values.

        Raises:
            ImageError, CaptureError: if the image is missing, cannot be decoded, or its size differs
                from that of its camera.
        """

    def has_mask(self, index: int, camera: str) -> bool:
        """Returns whether an image has a mask."""

    def mask(self, index: int, camera: str) -> NDArray[np.uint8]:
        """Returns a decoded mask, [H, W], 1 on the foreground.

        Raises:
            ImageError: if the mask cannot be decoded, or its size differs from that of its camera.
        """

    def encoded_image(self, index: int, camera: str) -> bytes:
        """Returns an image as the bytes of an 8-bit file: JPEG, PNG or WebP.

        Raises:
            KeyError: if the camera does not exist.
            ImageError, CaptureError: as for `image`.
        """

    def encoded_mask(self, index: int, camera: str) -> bytes | None:
        """Returns a mask as the bytes of a PNG or BMP file, or None if the image has no mask.

        Raises:
            ImageError, CaptureError: as for `mask`.
        """


class FileReader:
    """Reader of captures with one file per image, as in the Dynamic3DGaussians layout.

    Args:
        images: one mapping per frame, from camera name to image file.
        masks: one mapping per frame, from camera name to mask file. Cameras without a mask are
            absent.
        sizes: maps each camera name to the required (width, height) of its files.
        bit_depth: number of bits that the values of 16-bit images use (`describe_pictures`).
    """

    def __init__(
        self,
        images: Sequence[Files],
        masks: Sequence[Files],
        sizes: Mapping[str, Size],
        bit_depth: int | None = None,
    ) -> None:
        self.images, self.masks, self._sizes = tuple(images), tuple(masks), dict(sizes)
        self._bit_depth = bit_depth
        self.frame_count = len(self.images)

    def time(self, index: int) -> float | None:
        """Returns None, because the layout stores only a frame rate."""
        return None

    def image(self, index: int, camera: str) -> NDArray[np.uint8]:
        """Returns a decoded image, [H, W, 3]."""
        return decode_image(self.images[index][camera], size=self._sizes[camera], bit_depth=self._bit_depth)

    def has_mask(self, index: int, camera: str) -> bool:
        """Returns whether an image has a mask file."""
        return camera in self.masks[index]

    def mask(self, index: int, camera: str) -> NDArray[np.uint8]:
        """Returns a decoded mask, [H, W]."""
        return decode_mask(self.masks[index][camera], size=self._sizes[camera])

    def encoded_image(self, index: int, camera: str) -> bytes:
        """Returns an 8-bit JPEG, PNG or WebP file unchanged, and any other image as an 8-bit PNG."""
        path = self.images[index][camera]
        return eight_bit_file(read_bytes(path), self._sizes[camera], str(path), self._bit_depth)

    def encoded_mask(self, index: int, camera: str) -> bytes | None:
        """Returns the unchanged mask file, or None if the image has no mask file."""
        if not self.has_mask(index, camera):
            return None
        path = self.masks[index][camera]
        data = read_bytes(path)
        decode_mask(data, size=self._sizes[camera], name=str(path))  # raises an error if the file is damaged
        return data


def read_bytes(path: Path) -> bytes:
    """Reads the bytes of a file.

    Raises:
        CaptureError: if the file cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as fault:
        raise CaptureError(f"{path} cannot be read: {fault.strerror}") from fault
