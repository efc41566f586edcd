"""Structure of image files: format, size and completeness, read without decoding pixels. Requires only NumPy.

The structure covers the segments of a JPEG up to its end marker, the chunks and checksums of a PNG, the RIFF chunks of
a WebP, and the length of a BMP, PPM or PGM.
"""

from __future__ import annotations

import re
import struct
import zlib
from dataclasses import dataclass

import numpy as np

from scas4d_core.captures.jpeg import COM, SOS, always_decodes
from scas4d_core.errors import InputError

ACCEPTED = "JPEG, PNG, WebP, BMP, PPM or PGM"
"""Formats of images, for messages."""
RESEND = "the file is damaged; send the original again"
JFIF_SIZE = 14
"""Size of a JFIF segment without a thumbnail, in bytes. It contains the resolution in print, which is not used."""

_RAW_HEAD = re.compile(rb"P([56])[ \t\r\n]+(\d{1,6})[ \t\r\n]+(\d{1,6})[ \t\r\n]+(\d{1,6})[ \t\r\n]")
"""Header of a binary PGM or PPM file, up to the first byte of its pixels: format, width, height and maximum value."""


class ImageError(InputError):
    """Raised if an image or mask cannot be used. The message has the form "fault; remedy".

    Attributes:
        value: rejected property of the image, or None if the file as a whole is invalid.
    """

    def __init__(self, fault: str, remedy: str = "", value: str | None = None) -> None:
        super().__init__(fault, remedy)
        self.value = value


@dataclass(frozen=True)
class PictureHeader:
    """Header of an image file.

    Attributes:
        format: name of the format in Pillow: "JPEG", "PNG", "WEBP", "BMP" or "PPM".
        size: (width, height) in pixels.
        bits: bits per channel, of a palette per index.
        significant_bits: bits per channel of the original values according to the sBIT chunk of a PNG, or None.
        decodable: whether the structure alone guarantees that the pixels can be decoded.
        has_metadata: whether there may be metadata that affect the pixels, such as an orientation or a profile.
    """

    format: str
    size: tuple[int, int]
    bits: int = 8
    significant_bits: int | None = None
    decodable: bool = False
    has_metadata: bool = True


def picture_header(data: bytes | memoryview) -> PictureHeader:
    """Checks the structure of an image file and returns its header.

    Args:
        data: contents of the file in one contiguous buffer, which is not copied.

    Raises:
        ImageError: if the format is not accepted, or the file is empty, truncated, damaged, or has an unsupported bit
            depth or number of channels.

    >>> picture_header(b"P5 3 2 255 " + bytes(6)).size
    (3, 2)
    """
    data = memoryview(data)
    start = bytes(data[:12])
    if start.startswith(b"\xff\xd8\xff"):
        return _jpeg(data)
    if start.startswith(b"\x89PNG\r\n\x1a\n"):
        return _png(data)
    if start[:4] == b"RIFF" and start[8:] == b"WEBP":
        return _webp(data)
    if start[:2] == b"BM":
        return _bmp(data)
    if start[:2] in (b"P5", b"P6"):
        return _ppm(data)
    if not start:
        raise ImageError("the file is empty", f"send the image as {ACCEPTED}")
    raise ImageError(
        f"not a {ACCEPTED} file: it starts with {start[:8].hex(' ')}", "encode the image in one of these formats"
    )


def _truncated(kind: str, size: int) -> ImageError:
    return ImageError(f"the {kind} file is truncated after {size} bytes", "send the original file again")


def _jpeg(data: memoryview) -> PictureHeader:
    at, size, segments = 2, None, []
    while True:
        while bytes(data[at : at + 2]) == b"\xff\xff":  # fill bytes
            at += 1
        if at + 2 > len(data):
            raise _truncated("JPEG", len(data))
        if data[at] != 0xFF:
            raise ImageError(f"missing JPEG marker at byte {at}", RESEND)
        marker = data[at + 1]
        if marker == 0xD9:
            break
        if at + 4 > len(data):
            raise _truncated("JPEG", len(data))
        length = struct.unpack(">H", data[at + 2 : at + 4])[0]
        if length < 2 or at + 2 + length > len(data):
            raise _truncated("JPEG", len(data))
        body = bytes(data[at + 4 : at + 2 + length])
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            if len(body) < 6:
                raise ImageError("the JPEG frame header is too short", RESEND)
            bits, height, width, channels = struct.unpack(">BHHB", body[:6])
            if bits != 8 or channels not in (1, 3):
                value = f"{'CMYK, ' if channels == 4 else ''}{channels} channels of {bits} bits"
                raise ImageError(f"unsupported JPEG format: {value}", "use 8-bit RGB or greyscale", value)
            size = (width, height)
        segments.append((marker, body))
        at += 2 + length
        if marker == SOS:
            at = _end_of_scan(data, at)
    if size is None:
        raise ImageError("the JPEG file has no frame header", RESEND)
    others = [(marker, body) for marker, body in segments if 0xE0 <= marker <= 0xEF or marker == COM]
    has_metadata = any(marker != 0xE0 or len(body) != JFIF_SIZE or body[:5] != b"JFIF\0" for marker, body in others)
    return PictureHeader("JPEG", size, decodable=always_decodes(segments), has_metadata=has_metadata)


def _end_of_scan(data: memoryview, at: int) -> int:
    """Returns the position of the next marker other than a restart marker. A stuffed zero byte is not a marker."""
    scan = np.frombuffer(data, np.uint8, offset=at)
    places = np.flatnonzero(scan[:-1] == 0xFF)
    after = scan[places + 1]
    ends = places[(after != 0) & (after != 0xFF) & ((after < 0xD0) | (after > 0xD7))]
    if not len(ends):
        raise _truncated("JPEG", len(data))
    return at + int(ends[0])


def _png(data: memoryview) -> PictureHeader:
    at, size, bits, significant, pixels = 8, None, 8, None, False
    while True:
        if at + 12 > len(data):
            raise _truncated("PNG", len(data))
        length, kind = struct.unpack(">I4s", data[at : at + 8])
        end = at + 12 + length
        if end > len(data):
            raise _truncated("PNG", len(data))
        if zlib.crc32(data[at + 4 : end - 4]) != struct.unpack(">I", data[end - 4 : end])[0]:
            raise ImageError(
                f"checksum mismatch in the {kind!r} chunk at byte {at} of the PNG file",
                "the file was damaged in transit; send it again",
            )
        if size is None:
            if kind != b"IHDR" or length != 13:
                raise ImageError("the PNG file does not start with a valid header", RESEND)
            size, bits = struct.unpack(">II", data[at + 8 : at + 16]), data[at + 16]
        if kind == b"sBIT" and length:
            significant = max(data[at + 8 : end - 4])
        pixels |= kind == b"IDAT"
        if kind == b"IEND":
            break
        at = end
    if not pixels:
        raise ImageError("the PNG file contains no pixels", RESEND)
    return PictureHeader("PNG", size, bits, significant)


def _bmp(data: memoryview) -> PictureHeader:
    begin, kind = struct.unpack("<II", data[10:18]) if len(data) >= 34 else (0, 0)
    if kind == 12:
        width, height, _, bits = struct.unpack("<HHHH", data[18:26])
        compression = 0
    elif kind >= 40:
        width, height, _, bits, compression = struct.unpack("<iiHHI", data[18:34])
        height = abs(height)  # negative: rows from top to bottom
    else:
        raise ImageError("the BMP file has no valid header", RESEND)
    row = (width * bits + 31) // 32 * 4
    if compression in (0, 3) and begin + row * height > len(data):
        raise _truncated("BMP", len(data))
    return PictureHeader("BMP", (width, height))


def _ppm(data: memoryview) -> PictureHeader:
    head = _RAW_HEAD.match(data[:64])
    if head is None:
        raise ImageError(
            "the PPM or PGM file has no valid header", "begin it with P6 or P5, width, height and 255, without comments"
        )
    form, width, height, most = (int(number) for number in head.groups())
    if most != 255:
        raise ImageError(f"the maximum value of the PPM or PGM file is {most}", "use 255", f"maximum value {most}")
    size = head.end() + width * height * (3 if form == 6 else 1)
    if len(data) != size:
        raise ImageError(
            f"the PPM or PGM file has {len(data)} bytes, but its header declares {size}",
            "send one byte per channel and pixel, and nothing else",
        )
    return PictureHeader("PPM", (width, height), decodable=min(width, height) > 0, has_metadata=False)


def _webp(data: memoryview) -> PictureHeader:
    end = struct.unpack("<I", data[4:8])[0] + 8
    if end > len(data):
        raise _truncated("WebP", len(data))
    at, size, pixels = 12, None, False
    while at + 8 <= end:
        kind, length = struct.unpack("<4sI", data[at : at + 8])
        body = data[at + 8 : at + 8 + length]
        if len(body) < length or at + 8 + length > end:
            raise _truncated("WebP", len(data))
        if kind == b"VP8X" and length >= 10:
            size = int.from_bytes(body[4:7], "little") + 1, int.from_bytes(body[7:10], "little") + 1
        if kind == b"VP8 " and length >= 10:
            width, height = struct.unpack("<HH", body[6:10])
            size, pixels = size or (width & 0x3FFF, height & 0x3FFF), True
        if kind == b"VP8L" and length >= 5:
            bits = struct.unpack("<I", body[1:5])[0]
            size, pixels = size or ((bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1), True
        pixels |= kind == b"ANMF"
        at += 8 + length + length % 2
    if size is None or not pixels:
        raise ImageError("the WebP file contains no pixels", RESEND)
    return PictureHeader("WEBP", size)
