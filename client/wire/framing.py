"""Binary frame format: the magic `S4DF`, a little-endian uint32 length, a JSON header, then the files.

As the body of `PUT /v1/scenes/{id}/frames/{n}`, a frame has the content type `FRAME_MEDIA_TYPE`. Over `WS …/ingest`, it
is one binary message. The header lists the files with their sizes, and the files follow in that order, so that neither
side has to search for boundaries:

    offset  bytes  content
    0       4      magic, the ASCII letters S4DF
    4       4      length of the header, uint32, little-endian, at most `MAX_HEAD`
    8       …      the header, `FrameHead` as UTF-8 JSON
    …       …      the bytes of the files, `size` bytes each, without separators or trailing data
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated

from pydantic import AfterValidator, Field, ValidationError

from client.wire.base import MAX_CAMERAS, CameraName, Model
from client.wire.frames import CameraReceipt, FrameReceipt
from client.wire.service import ProblemDetails
from scas4d_core.errors import InputError
from scas4d_core.frame_times import check_time

FRAME_MEDIA_TYPE = "application/vnd.scas4d.frame"
MAGIC = b"S4DF"
PREFIX = struct.Struct("<4sI")
MAX_HEAD = 1 << 20
"""Maximum header size in bytes; a header for 512 cameras with masks takes about 100 kB."""
MAX_INDEX = 1_000_000_000


FrameSeconds = Annotated[float, AfterValidator(check_time)]
"""Time of a frame as sent, in seconds."""


class FramingError(InputError):
    """Raised for invalid frame bytes. The message states the problem and the remedy.

    Attributes:
        field: invalid field: `body`, or `time` in the header.
        value: invalid value.
    """

    def __init__(self, fault: str, remedy: str, *, field: str = "body", value: object = None) -> None:
        super().__init__(fault, remedy)
        self.field, self.value = field, fault if value is None else value


class FileKind(StrEnum):
    """The kind of a file: image or mask."""

    IMAGE = "image"
    MASK = "mask"


class FrameFile(Model):
    """One encoded file of a frame."""

    camera: CameraName
    kind: FileKind = FileKind.IMAGE
    size: int = Field(ge=0)
    """Size in bytes."""


class FrameHead(Model):
    """The header of a framed body: the frame's index, time and files."""

    index: int = Field(ge=0, le=MAX_INDEX)
    time: FrameSeconds | None = None
    """Timestamp in seconds; default: the index divided by the scene's frame rate."""
    files: Annotated[list[FrameFile], Field(min_length=1, max_length=2 * MAX_CAMERAS)]
    single_camera: bool = False
    """Whether the files belong to one camera, as in PUT …/frames/{n}/cameras/{c}, instead of a whole frame."""


class IngestAnswer(Model):
    """The response to one frame of a batch, or to one binary message of `WS …/ingest`."""

    index: int | None
    """Index of the frame; null if its header could not be read."""
    status: int
    """Status code, as for a frame that is sent alone: 202, 409, 413, 422, 429, 507 …"""
    retry_after: int | None = None
    """Seconds to wait; the same as Retry-After over HTTP."""
    receipt: FrameReceipt | CameraReceipt | None = None
    """Receipt, which confirms that the files are on disk; only with status 202."""
    problem: ProblemDetails | None = None
    """Problem document; only with other statuses."""
    missing: bool = False
    """Whether the refused frame was declared missing, so that later frames of its batch could be accepted."""


class FrameBatch(Model):
    """The response to a batch: one answer per frame, in order."""

    answers: list[IngestAnswer]


def frame_chunks(
    index: int,
    images: Mapping[str, bytes],
    masks: Mapping[str, bytes] | None = None,
    time: float | None = None,
    *,
    part: bool = False,
) -> list[bytes]:
    """Returns the bytes of a frame without copying the files: the prefix and header, then each file.

    Args:
        index: frame index.
        images: encoded image of each camera, keyed by camera name.
        masks: encoded masks, keyed by camera name; cameras may be omitted.
        time: timestamp in seconds; derived from the scene's frame rate if None.
        part: whether the frame contains only one camera's files.
    """
    kinds = ((FileKind.IMAGE, images), (FileKind.MASK, masks or {}))
    named = [(camera, kind, data) for kind, files in kinds for camera, data in files.items()]
    files = [FrameFile(camera=camera, kind=kind, size=len(data)) for camera, kind, data in named]
    head = FrameHead(index=index, time=time, files=files, single_camera=part).model_dump_json().encode()
    return [PREFIX.pack(MAGIC, len(head)) + head, *(data for _, _, data in named)]


def head_length(prefix: bytes | bytearray | memoryview) -> int:
    """Returns the size of the header in bytes, read from the first `PREFIX.size` bytes.

    Raises:
        FramingError: the bytes are not the start of a frame.
    """
    if len(prefix) < PREFIX.size:
        raise FramingError(f"is truncated within its prefix, after {len(prefix)} bytes", "send the whole frame")
    magic, length = PREFIX.unpack_from(prefix)
    if magic != MAGIC:
        raise FramingError(
            f"begins with the bytes {bytes(magic).hex(' ')} instead of S4DF",
            "send a frame in the format described in docs/api.md",
        )
    if length > MAX_HEAD:
        raise FramingError(f"declares a header of {length} bytes", f"use a header of at most {MAX_HEAD} bytes")
    return int(length)


def parse_head(data: bytes | bytearray | memoryview) -> FrameHead:
    """Parses the JSON header.

    Raises:
        FramingError: the header is not valid JSON or has invalid fields.
    """
    try:
        return FrameHead.model_validate_json(bytes(data))
    except ValidationError as error:
        first = error.errors()[0]
        if isinstance(wrong := first.get("ctx", {}).get("error"), InputError) and first["loc"] == ("time",):
            fault = f"has an invalid time: {wrong.fault}"
            raise FramingError(fault, wrong.remedy, field="time", value=first["input"]) from None
        field = ".".join(str(part) for part in first["loc"])
        raise FramingError(
            f"has an invalid header{' field ' + field if field else ''}: {first['msg']}", "correct the header"
        ) from None
