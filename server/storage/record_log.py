"""Format of checksummed, append-only records that readers can locate again after truncation or bit flips.

A record consists of a header, a head (JSON), a body (raw bytes) and a checksum:

    bytes  content
    4      magic S4DR
    1      format version, 1 or 2, which selects the checksum
    1      kind, `LogRecordKind`
    2      zero
    4      length of the head
    8      index of the frame that the record belongs to
    8      length of the body
    4      CRC-32 of the preceding 28 bytes and the head
    …      head, UTF-8 JSON
    …      body
    16     BLAKE3 digest truncated to 128 bits. Version 1: over everything before it. Version 2: over header, CRC and
           head, followed by the BLAKE3 digest (32 bytes) of each file

All numbers are unsigned little-endian integers. A header with a matching CRC can be trusted even within damaged data,
so a reader can search for the next record. The BLAKE3 digest proves that the record is unchanged. The checksum follows
the body because a frame is written to disk while it is being received. In version 2, the head contains `files`, in
which each `size` locates a file in the body. The identity of a frame uses the same file digests, so that no byte is
hashed twice.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from typing import Any, NamedTuple, Protocol

from blake3 import blake3

MAGIC = b"S4DR"
WHOLE, BY_FILE = 1, 2
"""Format versions: one checksum over the whole record, or one built from the digest of each file."""
HEADER = struct.Struct("<4sBBHIQQ")
CRC = struct.Struct("<I")
PREFIX = HEADER.size + CRC.size
CHECKSUM = 16
MAX_HEAD = 1 << 22


class LogRecordKind(IntEnum):
    """Kind of a record."""

    EVENT = 1
    """Event of a frame or of the scene, stored completely in the head."""
    PICTURES = 2
    """Encoded image files of a frame, or of a single camera of a frame."""


@dataclass(frozen=True, eq=False)
class LogRecord:
    """Record as read from disk.

    Attributes:
        kind, index: kind and frame index from the header.
        text: unparsed JSON head.
        body, files: views into the input; `files` is set only for version 2.
        digests: BLAKE3 digest of each file.
        size: size of the record in bytes.
    """

    kind: int
    index: int
    text: bytes
    body: memoryview
    files: tuple[memoryview, ...]
    digests: tuple[bytes, ...]
    size: int

    @cached_property
    def head(self) -> Any:
        """Parsed head."""
        return json.loads(self.text)


@dataclass(frozen=True)
class Damage:
    """Byte range [start, end) without an intact record, and the reason.

    `index` and `kind` are those of the damaged record, and are set only if its header can still be trusted.
    """

    start: int
    end: int
    reason: str
    index: int | None = None
    kind: int | None = None
    torn: bool = False
    """Whether the damage extends to the end of the log, as after an interrupted append."""


def encode_opening(kind: int, index: int, head: Any, body_length: int, version: int = WHOLE) -> bytes:
    """Encodes the header and head of a record; the body and the checksum are written after them."""
    text = json.dumps(head, separators=(",", ":"), allow_nan=False).encode()
    header = HEADER.pack(MAGIC, version, kind, 0, len(text), index, body_length)
    return header + CRC.pack(zlib.crc32(text, zlib.crc32(header))) + text


def checksum(*pieces: bytes | bytearray | memoryview) -> bytes:
    """Returns the truncated BLAKE3 digest of consecutive pieces.

    The pieces form a whole record, or its opening followed by the digest of each file.
    """
    digest = blake3()
    for piece in pieces:
        digest.update(piece)
    return digest.digest(CHECKSUM)


def encode_record(kind: int, index: int, head: Any, body: bytes = b"") -> bytes:
    """Encodes a complete record of version 1."""
    start = encode_opening(kind, index, head, len(body))
    return start + body + checksum(start, body)


class _Opening(NamedTuple):
    """Fields of a header that can be trusted, and the offsets at which the head and the record end."""

    version: int
    kind: int
    frame: int
    head_end: int
    end: int


def _opening(data: bytes, at: int) -> _Opening | str:
    """Returns the header and head at a byte offset, or the reason why they cannot be trusted."""
    if len(data) - at < HEADER.size or data[at : at + len(MAGIC)] != MAGIC:
        return "no record starts here"
    _, version, kind, nought, head_length, index, body_length = HEADER.unpack_from(data, at)
    head_end = at + PREFIX + head_length
    if version not in (WHOLE, BY_FILE) or nought or head_length > MAX_HEAD or head_end > len(data):
        return "the header has an unknown version, is damaged, or is truncated"
    expected = CRC.unpack_from(data, at + HEADER.size)[0]
    if zlib.crc32(data[at + PREFIX : head_end], zlib.crc32(data[at : at + HEADER.size])) != expected:
        return "the header or head fails its checksum"
    return _Opening(version, kind, index, head_end, head_end + body_length + CHECKSUM)


def read_at(data: bytes, at: int) -> tuple[LogRecord | Damage, int]:
    """Reads the record that starts at a byte offset.

    Returns:
        The record or the damage, and its end. If the header cannot be trusted, the damage ends at the next trusted
        header.
    """
    opening = _opening(data, at)
    if isinstance(opening, str):
        return _skip(data, at, opening)
    version, kind, index, head_end, end = opening
    if end > len(data):
        damage, after = _skip(data, at, f"the record ends after {len(data) - at} of {end - at} bytes")
        return Damage(at, after, damage.reason, index, kind, damage.torn), after
    text, body = bytes(data[at + PREFIX : head_end]), memoryview(data)[head_end : end - CHECKSUM]
    files: tuple[memoryview, ...] = ()
    if version == BY_FILE:
        try:
            files = _files(json.loads(text), body)
        except (KeyError, TypeError, ValueError) as error:  # intact, but written by another program
            return Damage(at, end, f"the head is not a valid record head ({error!r})", index, kind), end
    digests = tuple(blake3(file).digest() for file in files)
    pieces = (data[at : end - CHECKSUM],) if version == WHOLE else (data[at:head_end], *digests)
    if checksum(*pieces) != data[end - CHECKSUM : end]:
        return Damage(at, end, "the record fails its checksum", index, kind), end
    return LogRecord(kind, index, text, body, files, digests, end - at), end


def _files(head: Any, body: memoryview) -> tuple[memoryview, ...]:
    """Splits a body into its files.

    Raises:
        KeyError, TypeError, ValueError: the head does not contain valid file sizes.
    """
    files, at = [], 0
    for file in head["files"]:
        files.append(body[at : at + file["size"]])
        at += file["size"]
    if at != len(body):
        raise ValueError(f"the files have {at} bytes, but the body has {len(body)}")
    return tuple(files)


PIECE = 1 << 22
"""Number of bytes read at a time."""
DECIDABLE_BYTES = 2 * (MAX_HEAD + PREFIX + CHECKSUM)
"""Number of bytes that are sufficient to decide whether a record without a body, such as an event, is intact."""


class Readable(Protocol):
    """Interface of a file that is read in pieces."""

    def read(self, size: int, /) -> bytes:
        """Reads at most `size` bytes; returns no bytes at the end of the file."""


def stream_records(file: Readable) -> Iterator[LogRecord | Damage]:
    """Yields each record in a log of small records (version 1), and the damage between records.

    The log need not fit in memory.
    """
    data, start, at, ended = b"", 0, 0, False
    while True:
        record, after = read_at(data, at)
        if isinstance(record, Damage):
            unsure = len(data) - at < DECIDABLE_BYTES or after == len(data)
            if unsure and not ended:
                piece = file.read(PIECE)
                ended = not piece
                data, start, at = data[at:] + piece, start + at, 0
                continue
            if at == len(data):
                return
            record = replace(record, start=start + record.start, end=start + record.end)
        elif record.files:
            record = Damage(start + at, start + after, "the record version is not allowed here")
        yield record
        at = after


def _skip(data: bytes, at: int, reason: str) -> tuple[Damage, int]:
    """Returns the damage up to the next trusted header or the end of the data."""
    following = at
    while (following := data.find(MAGIC, following + 1)) >= 0:
        if not isinstance(_opening(data, following), str):
            return Damage(at, following, reason), following
    return Damage(at, len(data), reason, torn=True), len(data)


READ_BYTES = 1 << 20
"""Number of bytes that `check_record` reads at a time."""


def check_record(file: Readable) -> Iterator[int]:
    """Verifies a file that contains one record and yields the size of each piece in bytes.

    The record need not fit in memory.

    Raises:
        ValueError: the record is not intact.
    """
    header = file.read(PREFIX)
    head_length = HEADER.unpack_from(header)[4] if len(header) == PREFIX else 0
    head = file.read(min(head_length, MAX_HEAD))
    opening = _opening(header + head, 0)
    if isinstance(opening, str):
        raise ValueError(opening)
    version, body_length = opening.version, opening.end - opening.head_end - CHECKSUM
    try:
        sizes = [body_length] if version == WHOLE else [int(entry["size"]) for entry in json.loads(head)["files"]]
    except (KeyError, TypeError) as error:  # intact, but written by another program
        raise ValueError(f"the head is not a valid record head ({error!r})") from None
    whole = blake3(header + head)
    for size in sizes:
        digest = whole if version == WHOLE else blake3()
        while size:
            piece = file.read(min(size, READ_BYTES))
            if not piece:
                raise ValueError("the record is truncated")
            digest.update(piece)
            size -= len(piece)
            yield len(piece)
        if version == BY_FILE:
            whole.update(digest.digest())
    if whole.digest(CHECKSUM) != file.read(CHECKSUM) or file.read(1):
        raise ValueError("the record fails its checksum")
