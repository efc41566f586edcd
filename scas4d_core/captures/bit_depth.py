"""16-bit PNG files: their values, the bit depth that the values use, and their conversion to 8 bits.

Cameras with 10, 12 or 14 bits often store their values in 16-bit files without scaling them.
"""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from scas4d_core.captures.picture_file import ImageError, picture_header

BIT_DEPTHS = (8, 10, 12, 14, 16)
"""Bit depths for which the values of 16-bit files are checked."""
_GREY_ALPHA, _RGB_ALPHA = 4, 6
"""Colour types of PNG files with alpha."""


def is_sixteen_bit(head: bytes | memoryview) -> bool:
    """Returns whether a file is a PNG with 16 bits per channel, given its first 25 bytes."""
    return bytes(head[:4]) == b"\x89PNG" and bytes(head[24:25]) == b"\x10"


def sixteen_bit_values(data: bytes | memoryview) -> NDArray[np.uint16]:
    """Returns the values of a 16-bit PNG file.

    Returns:
        Values [H, W] for grey, otherwise [H, W, C]. The last channel is alpha if C is 2 or 4.

    Raises:
        Exception: of any type, if Pillow cannot decode the file.
    """
    colour_type = data[25]
    if colour_type == _GREY_ALPHA:  # two bytes each for grey and alpha, read as four channels
        return _read_as(data, "RGBA").view(">u2").astype(np.uint16)
    with Image.open(io.BytesIO(data), formats=("PNG",)) as picture:
        if picture.mode == "I;16":
            return np.array(picture)
    # Pillow keeps only the high byte of colours. If it is asked for little-endian values, it keeps the low byte.
    channels = "RGBA" if colour_type == _RGB_ALPHA else "RGB"
    high, low = (_read_as(data, f"{channels};16{order}").astype(np.uint16) for order in "BL")
    return (high << 8 | low).astype(np.uint16)


def _read_as(data: bytes | memoryview, rawmode: str) -> NDArray[np.uint8]:
    with Image.open(io.BytesIO(data), formats=("PNG",)) as picture:
        picture.tile = [(*tile[:3], rawmode) for tile in picture.tile]  # type: ignore[misc]
        return np.array(picture)


def find_bit_depth(files: Iterable[bytes | memoryview | Path]) -> int:
    """Returns the bit depth that the values of 16-bit PNG files use together.

    It is the smallest of `BIT_DEPTHS` that holds all values, or the depth that the sBIT chunk of a file states, if it
    holds all values. (A file that follows the PNG specification scales its values to 16 bits, so it does not.) Files
    that cannot be decoded are ignored. Images that are black say nothing; the result is then 16.

    >>> file = io.BytesIO()
    >>> Image.fromarray(np.array([[9, 3900]], np.uint16)).save(file, "PNG")
    >>> find_bit_depth([file.getvalue()])
    12
    """
    largest, stated = 0, 0
    for file in files:
        try:
            data = file.read_bytes() if isinstance(file, Path) else file
            header = picture_header(data)
            values = sixteen_bit_values(data)
        except Exception:  # decode_image reports it when the image is used
            continue
        colours = values[..., : values.shape[-1] - 1] if values.ndim == 3 and values.shape[-1] != 3 else values
        largest = max(largest, int(colours.max()))
        stated = max(stated, header.significant_bits or 0)
    if not largest:
        return 16
    if BIT_DEPTHS[0] <= stated <= 16 and largest < 1 << stated:
        return stated
    return next(depth for depth in BIT_DEPTHS if largest < 1 << depth)


def to_eight_bits(values: NDArray[np.uint16], bit_depth: int) -> NDArray[np.uint8]:
    """Scales values of a bit depth to 8 bits, rounded. Alpha that exceeds the bit depth is scaled from 16 bits.

    Args:
        values: values as from `sixteen_bit_values`.
        bit_depth: number of bits that the values use.

    Raises:
        ImageError: if a value exceeds the bit depth.

    >>> to_eight_bits(np.array([[0, 2048, 4095]], np.uint16), 12)
    array([[  0, 128, 255]], dtype=uint8)
    """
    if values.ndim == 3 and values.shape[-1] in (2, 4):
        alpha = values[..., -1:]
        alpha_depth = bit_depth if alpha.max() < 1 << bit_depth else 16
        return np.concatenate([to_eight_bits(values[..., :-1], bit_depth), to_eight_bits(alpha, alpha_depth)], axis=-1)
    most = (1 << bit_depth) - 1
    if (largest := int(values.max())) > most:
        raise ImageError(
            f"the value {largest} exceeds {bit_depth} bits, the bit depth of this capture",
            "give the bit depth with --bit-depth",
            str(largest),
        )
    return ((values.astype(np.uint32) * 510 + most) // (2 * most)).astype(np.uint8)
