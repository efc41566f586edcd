"""Validation of a frame's image files without decoding pixels: names, sizes and file structure.

The structure checks cover the segments of a JPEG up to its end marker, the chunks and checksums of a PNG, the RIFF
chunks of a WebP, and the length of a PPM or PGM.
"""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

from PIL import Image

from client.wire import FileKind, FrameFile
from client.wire.framing import MAX_HEAD, PREFIX
from scas4d_core.cameras import Camera, Rig
from scas4d_core.errors import InputError
from server.problems import Problem, count_noun

_SCAN_END = re.compile(rb"\xff(?![\x00\xd0-\xd7\xff])(?=[\x00-\xff])", re.DOTALL)
_RAW_HEAD = re.compile(rb"P([56])[ \t\r\n]+(\d{1,6})[ \t\r\n]+(\d{1,6})[ \t\r\n]+(\d{1,6})[ \t\r\n]")
"""Header of a binary PGM or PPM file, up to the first byte of its pixels: format, width, height and maximum value."""
MASK = "mask."
EXIF_ORIENTATION = 0x0112

PIXEL_BYTES = 5
"""Maximum number of bytes per pixel in a file; RGBA noise in a PNG needs slightly more than 4."""
METADATA_BYTES = 1_000_000
"""Maximum size in bytes of the metadata in a file, such as a colour profile or a preview."""


def field_of(file: FrameFile) -> str:
    """Returns the name of a file in forms and responses: `<camera>` or `mask.<camera>`."""
    return MASK + file.camera if file.kind == FileKind.MASK else file.camera


def largest_file(camera: Camera) -> int:
    """Returns the maximum size in bytes of an encoded image or mask of a camera."""
    return camera.width * camera.height * PIXEL_BYTES + METADATA_BYTES


def largest_frame(rig: Rig) -> int:
    """Returns the maximum size in bytes of an S4DF frame with images and masks of all cameras."""
    return PREFIX.size + MAX_HEAD + 2 * sum(largest_file(camera) for camera in rig.cameras)


def check_size(camera: Camera, field: str, size: int) -> None:
    """Refuses a file by its announced size, before it is received.

    Raises:
        Problem: 413 if the file is larger than an image of the camera can be.
    """
    if size > (most := largest_file(camera)):
        raise Problem(
            413,
            f"{field}: the file has {size} bytes, but a {camera.width}x{camera.height} image has at most {most}",
            field=field,
            value=size,
            remedy="send only the image, encoded as JPEG, PNG or WebP",
        )


def check_files(rig: Rig, files: Sequence[FrameFile], *, whole: bool) -> None:
    """Checks that each file belongs to a camera of the rig and appears only once.

    A whole frame must contain an image from every camera, and masks for all cameras or none.

    Raises:
        Problem: 422 with the name of the invalid file; 413 if an announced size is too large.
    """
    names = set(rig.names)
    seen: dict[FileKind, set[str]] = {FileKind.IMAGE: set(), FileKind.MASK: set()}
    for file in files:
        field = field_of(file)
        if file.camera not in names:
            raise Problem(
                422,
                f"the rig has no camera {file.camera!r}",
                field=field,
                value=file.camera,
                remedy=f"use one of {', '.join(rig.names)}",
            )
        if file.camera in seen[file.kind]:
            raise Problem(
                422,
                f"duplicate file {field!r}",
                field=field,
                value=file.camera,
                remedy="send one image and at most one mask per camera",
            )
        check_size(rig[file.camera], field, file.size)
        seen[file.kind].add(file.camera)
    if not whole:
        return
    for kind, given in seen.items():
        missing = sorted(names - given)
        if missing and (given or kind == FileKind.IMAGE):
            image = kind == FileKind.IMAGE
            raise Problem(
                422,
                f"no {'image' if image else 'mask'} for {count_noun(len(missing), 'camera')}: {', '.join(missing)}",
                field=missing[0] if image else MASK + missing[0],
                value="nothing",
                remedy=f"add {'it' if len(missing) == 1 else 'one for each'}"
                + (
                    ", or send camera by camera: PUT …/frames/{n}/cameras/{c}" if image else ", or send no masks at all"
                ),
            )


def check_picture(rig: Rig, file: FrameFile, data: memoryview) -> None:
    """Checks that a file is complete, in an accepted format, not rotated by EXIF, and has the camera's image size.

    Raises:
        Problem: 422 with the name of the file, its fault and the remedy.
    """
    camera, field = rig[file.camera], field_of(file)
    try:
        header = image_header(data)
    except StructureError as error:
        value = error.value or count_noun(len(data), "byte")
        raise Problem(422, f"{field}: {error.fault}", field=field, value=value, remedy=error.remedy) from None
    if (header.width, header.height) != (camera.width, camera.height):
        raise Problem(
            422,
            f"{field}: the image is {header.width}x{header.height}, but the camera is {camera.width}x{camera.height}",
            field=field,
            value=f"{header.width}x{header.height}",
            remedy="send images of the size for which the camera was calibrated",
        )
    if file.kind == FileKind.MASK and header.format != "png":
        raise Problem(
            422,
            f"{field}: masks must be PNG, got {header.format}",
            field=field,
            value=header.format,
            remedy="encode masks as PNG",
        )
    if header.exif and (orientation := _orientation(data)) != 1:
        raise Problem(
            422,
            f"{field}: EXIF orientation {orientation} would rotate the image",
            field=field,
            value=orientation,
            remedy="store the pixels in the calibrated orientation and remove the tag",
        )


def _orientation(data: memoryview) -> int:
    try:
        with Image.open(io.BytesIO(data), formats=["JPEG"]) as picture:  # reads only the segments, without decoding
            return int(picture.getexif().get(EXIF_ORIENTATION, 1))
    except Exception:  # damaged metadata; the worker decodes the file and reports errors
        return 1


class StructureError(InputError):
    """Error for a file that is not a complete image in an accepted format.

    Attributes:
        fault: description of the fault.
        remedy: advice on what to send instead.
        value: unsupported property of the image, or None if the file as a whole is invalid.
    """

    def __init__(self, fault: str, remedy: str, value: str | None = None) -> None:
        super().__init__(fault, remedy)
        self.value = value


@dataclass(frozen=True)
class ImageHeader:
    """Header of an image, with its format ("jpeg", "png", "webp" or "ppm") and its size in pixels."""

    format: str
    width: int
    height: int
    exif: bool = False
    """Whether a JPEG has an EXIF segment, which may request a rotation."""


def image_header(data: bytes | memoryview) -> ImageHeader:
    """Checks the structure of a file up to its end and returns its header.

    Args:
        data: contents of the file in one contiguous buffer, which is not copied.

    Raises:
        StructureError: the file is not in an accepted format, is truncated, damaged, CMYK or animated, or has an
            unsupported bit depth.
    """
    data = memoryview(data)
    start = bytes(data[:12])
    if start.startswith(b"\xff\xd8\xff"):
        return _jpeg(data)
    if start.startswith(b"\x89PNG\r\n\x1a\n"):
        return _png(data)
    if start[:4] == b"RIFF" and start[8:] == b"WEBP":
        return _webp(data)
    if start[:2] in (b"P5", b"P6"):
        return _ppm(data)
    if not start:
        raise StructureError("the file is empty", "send the image as JPEG, PNG or WebP")
    raise StructureError(
        f"not a JPEG, PNG, WebP, PPM or PGM file: it starts with {start[:8].hex(' ')}",
        "encode the image in one of these formats",
    )


def _truncated(kind: str, size: int) -> StructureError:
    return StructureError(
        f"the {kind} file is truncated after {size} bytes",
        "send the original file again",
    )


def _jpeg(data: memoryview) -> ImageHeader:
    at, header, components, exif = 2, None, 0, False
    while True:
        while bytes(data[at : at + 2]) == b"\xff\xff":  # fill bytes
            at += 1
        if at + 2 > len(data):
            raise _truncated("JPEG", len(data))
        if data[at] != 0xFF:
            raise StructureError(f"missing JPEG marker at byte {at}", "the file is damaged; send the original again")
        marker = data[at + 1]
        if marker == 0xD9:
            break
        if at + 4 > len(data):
            raise _truncated("JPEG", len(data))
        length = struct.unpack(">H", data[at + 2 : at + 4])[0]
        if length < 2 or at + 2 + length > len(data):
            raise _truncated("JPEG", len(data))
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            if length < 8:
                raise StructureError(
                    "the JPEG frame header is too short", "the file is damaged; send the original again"
                )
            bits, height, width, channels = struct.unpack(">BHHB", data[at + 4 : at + 10])
            if bits != 8 or channels not in (1, 3):
                kind = "CMYK, " if channels == 4 else ""
                value = f"{kind}{channels} channels of {bits} bits"
                raise StructureError(f"unsupported JPEG format: {value}", "send 8-bit RGB or greyscale", value)
            header = ImageHeader("jpeg", width, height)
            components = channels if marker in (0xC0, 0xC1) else 0
        exif |= marker == 0xE1 and bytes(data[at + 4 : at + 10]) == b"Exif\0\0"
        at += 2 + length
        if marker == 0xDA:
            # In a sequential JPEG with a single scan, only the end marker follows the scan, and scan data cannot
            # contain that marker. A file that ends with it is therefore complete. Other files are checked scan by scan.
            if at <= len(data) - 2 and data[at - length + 2] == components and bytes(data[-2:]) == b"\xff\xd9":
                break
            at = _end_of_scan(data, at)
    if header is None:
        raise StructureError("the JPEG file has no frame header", "the file is damaged; send the original again")
    return replace(header, exif=exif)


def _end_of_scan(data: memoryview, at: int) -> int:
    """Returns the end of the entropy-coded data after `at`.

    The end is the position of the next marker other than a restart marker. A stuffed zero byte is not a marker.
    """
    end = _SCAN_END.search(data, at)
    if end is None:
        raise _truncated("JPEG", len(data))
    return end.start()


def _png(data: memoryview) -> ImageHeader:
    at, header, pixels = 8, None, False
    while True:
        if at + 12 > len(data):
            raise _truncated("PNG", len(data))
        length, kind = struct.unpack(">I4s", data[at : at + 8])
        end = at + 12 + length
        if end > len(data):
            raise _truncated("PNG", len(data))
        if zlib.crc32(data[at + 4 : end - 4]) != struct.unpack(">I", data[end - 4 : end])[0]:
            raise StructureError(
                f"checksum mismatch in the {kind!r} chunk at byte {at} of the PNG file",
                "the file was damaged in transit; send it again",
            )
        if header is None:
            if kind != b"IHDR" or length != 13:
                raise StructureError(
                    "the PNG file does not start with a valid header", "the file is damaged; send the original again"
                )
            header = ImageHeader("png", *struct.unpack(">II", data[at + 8 : at + 16]))
            if data[at + 16] == 16:
                raise StructureError(
                    "the PNG file has 16 bits per channel", "convert the image to 8 bits per channel", "16 bits"
                )
        if kind == b"acTL":
            raise StructureError("the PNG file is animated", "send a single still image", "animated")
        pixels |= kind == b"IDAT"
        if kind == b"IEND":
            break
        at = end
    if not pixels:
        raise StructureError("the PNG file contains no pixels", "the file is damaged; send the original again")
    return header


def _ppm(data: memoryview) -> ImageHeader:
    head = _RAW_HEAD.match(data[:64])
    if head is None:
        raise StructureError(
            "the PPM or PGM file has no valid header", "begin it with P6 or P5, width, height and 255, without comments"
        )
    form, width, height, most = (int(number) for number in head.groups())
    if most != 255:
        raise StructureError(f"the maximum value of the PPM or PGM file is {most}", "use 255", f"maximum value {most}")
    size = head.end() + width * height * (3 if form == 6 else 1)
    if len(data) != size:
        raise StructureError(
            f"the PPM or PGM file has {len(data)} bytes, but its header declares {size}",
            "send one byte per channel and pixel, and nothing else",
        )
    return ImageHeader("ppm", width, height)


def _webp(data: memoryview) -> ImageHeader:
    size = struct.unpack("<I", data[4:8])[0] + 8
    if size > len(data):
        raise _truncated("WebP", len(data))
    at, header, pixels = 12, None, False
    while at + 8 <= size:
        kind, length = struct.unpack("<4sI", data[at : at + 8])
        body = data[at + 8 : at + 8 + length]
        if len(body) < length or at + 8 + length > size:
            raise _truncated("WebP", len(data))
        if kind in (b"ANIM", b"ANMF"):
            raise StructureError("the WebP file is animated", "send a single still image", "animated")
        if kind == b"VP8X" and length >= 10:
            width, height = int.from_bytes(body[4:7], "little") + 1, int.from_bytes(body[7:10], "little") + 1
            header = ImageHeader("webp", width, height)
        if kind == b"VP8 " and length >= 10:
            width, height = struct.unpack("<HH", body[6:10])
            header, pixels = header or ImageHeader("webp", width & 0x3FFF, height & 0x3FFF), True
        if kind == b"VP8L" and length >= 5:
            bits = struct.unpack("<I", body[1:5])[0]
            header, pixels = header or ImageHeader("webp", (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1), True
        at += 8 + length + length % 2
    if header is None or not pixels:
        raise StructureError("the WebP file contains no pixels", "the file is damaged; send the original again")
    return header
