"""`PictureReader`: how a capture gets its pictures. `FileReader` reads files. Numpy and Pillow only."""

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
    """Pictures and masks of pinhole cameras by frame and camera, training and test cameras alike.

    A picture has the size of its camera in the full rig, whatever the capture's `image_scale`. A reader keeps at most
    a few pictures a camera in memory, and reading frame after frame costs each once.
    """

    @property
    def frame_count(self) -> int:
        """Number of frames T."""

    def time(self, index: int) -> float | None:
        """Seconds, rising with the frame; None where the pictures do not say, and the frame rate counts."""

    def image(self, index: int, camera: str) -> NDArray[np.uint8]:
        """Decodes a picture, [H, W, 3] sRGB values.

        Raises:
            ImageError: it cannot be decoded, or has another size than its camera.
        """

    def has_mask(self, index: int, camera: str) -> bool:
        """True where there is a mask."""

    def mask(self, index: int, camera: str) -> NDArray[np.uint8]:
        """Decodes a mask, [H, W], 1 on the foreground."""

    def encoded_image(self, index: int, camera: str) -> bytes:
        """A picture as a file of 8 bits that the service takes: JPEG, PNG or WebP.

        Raises:
            KeyError: no such camera.
            CaptureError: the file cannot be read.
        """

    def encoded_mask(self, index: int, camera: str) -> bytes | None:
        """A mask as PNG or BMP; None where there is none."""


class FileReader:
    """Reads one file a picture, as the Dynamic3DGaussians layout has them.

    Args:
        images: [T] files by camera name.
        masks: [T] files by camera name; a camera without one has no mask then.
        sizes: (width, height) that the files of a camera must have.
    """

    def __init__(self, images: Sequence[Files], masks: Sequence[Files], sizes: Mapping[str, Size]) -> None:
        self.images, self.masks, self._sizes = tuple(images), tuple(masks), dict(sizes)
        self.frame_count = len(self.images)

    def time(self, index: int) -> float | None:
        """None: this layout has a frame rate alone."""
        return None

    def image(self, index: int, camera: str) -> NDArray[np.uint8]:
        """Decodes a picture, [H, W, 3]."""
        return decode_image(self.images[index][camera], size=self._sizes[camera])

    def has_mask(self, index: int, camera: str) -> bool:
        """True where there is a file."""
        return camera in self.masks[index]

    def mask(self, index: int, camera: str) -> NDArray[np.uint8]:
        """Decodes a mask, [H, W]."""
        return decode_mask(self.masks[index][camera], size=self._sizes[camera])

    def encoded_image(self, index: int, camera: str) -> bytes:
        """The file as it is; one of 16 bits is rounded to 8."""
        return eight_bit_file(read_bytes(self.images[index][camera]), str(self.images[index][camera]))

    def encoded_mask(self, index: int, camera: str) -> bytes | None:
        """The file as it is; None where there is none."""
        return read_bytes(self.masks[index][camera]) if self.has_mask(index, camera) else None


def read_bytes(path: Path) -> bytes:
    """The bytes of a file.

    Raises:
        CaptureError: it cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as fault:
        raise CaptureError(f"{path}: cannot be read ({fault.strerror})") from fault
