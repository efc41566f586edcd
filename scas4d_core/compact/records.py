"""Records of a compact file, each with a checksummed header and a body; the headers suffice to list the records.

A file can be read while it is being written: an incomplete record at its end is ignored. Any other damage is reported
with its offset.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path
from typing import Any, BinaryIO

from scas4d_core.compact.planes import PlaneError, compress, decompress

MAGIC = b"s4dR"
"""First bytes of each record, and thus of the file."""
_HEAD = struct.Struct("<4sB3xqdII")
"""Magic, kind, frame, time in seconds, size of the body, CRC-32 of the body; the CRC-32 of this header follows."""
_CHECKSUM = struct.Struct("<I")
HEAD_SIZE = _HEAD.size + _CHECKSUM.size
COUNT_BYTES = 4
LONGEST = 1 << 24
"""Maximum size of a note's text, in bytes; prevents a damaged file from exhausting memory."""


class RecordKind(IntEnum):
    """Kind of a record, which determines the content of its body."""

    HEAD = 1
    """JSON: version, world, bounds."""
    BORN = 2
    """Gaussians coded without a reference, either those of the first frame or newborn ones."""
    KEY = 3
    """A key state, coded relative to the birth records of its Gaussians."""
    DELTA = 4
    """A state coded relative to the previous one."""
    PARTS = 5
    """The part label of each Gaussian."""
    INDEX = 6
    """Offsets of all records; the last record of a file."""
    NOTE = 7
    """JSON about the frame whose state follows."""


class FileError(ValueError):
    """Raised if a compact file cannot be read or written; the message names the file and the problem."""


class FormatError(FileError):
    """Raised if a compact file has an unsupported format version; the file is left unchanged."""


class DamagedFileError(FileError):
    """Raised if a compact file is damaged; the message names the file and the offset."""


@dataclass(frozen=True)
class Record:
    """Location of a record in a file.

    Attributes:
        kind: kind of the record.
        frame: frame index, or −1 for none.
        time: time in seconds.
        offset: offset of the body in the file.
        size: size of the body in bytes.
        checksum: CRC-32 of the body.
    """

    kind: RecordKind
    frame: int
    time: float
    offset: int
    size: int
    checksum: int

    @property
    def end(self) -> int:
        """File offset of the end of the body."""
        return self.offset + self.size

    def at(self, offset: int) -> Record:
        """Returns a copy of the record whose header is at the given file offset."""
        return replace(self, offset=offset + HEAD_SIZE)


def record_bytes(kind: RecordKind, body: bytes, frame: int = -1, time: float = 0.0) -> bytes:
    """Serializes a record.

    >>> import io
    >>> file = io.BytesIO(record_bytes(RecordKind.KEY, b"abc", 7, 0.5))
    >>> (found,) = scan(file, 0, "a file")
    >>> found.kind.name, found.frame, read_body(file, found, "a file")
    ('KEY', 7, b'abc')
    """
    head = _HEAD.pack(MAGIC, kind, frame, time, len(body), zlib.crc32(body))
    return head + _CHECKSUM.pack(zlib.crc32(head)) + body


def checksum_bytes(record: Record) -> bytes:
    """Returns the checksum of a record's body as bytes.

    The body of a delta record begins with the checksum of the previous state.
    """
    return _CHECKSUM.pack(record.checksum)


def scan(file: BinaryIO, offset: int, name: str) -> Iterator[Record]:
    """Yields the complete records from an offset onwards; an incomplete record at the end is ignored.

    Args:
        file: open file to read from.
        offset: offset of the first record to read.
        name: name of the file, used in error messages.

    Raises:
        DamagedFileError: if there is no valid record at an offset where one is expected.
        FileError: if a record has an unknown kind.
    """
    file.seek(0, 2)
    size = file.tell()
    while offset + HEAD_SIZE <= size:
        file.seek(offset)
        data = file.read(HEAD_SIZE)
        if not any(data) and _is_zero(file):  # after a power failure, the end of a file may be zeros
            return
        record = parse_head(data, offset, name)
        if record.end > size:
            return
        yield record
        offset = record.end


def _is_zero(file: BinaryIO) -> bool:
    """Returns whether the rest of the file consists only of zero bytes."""
    while piece := file.read(1 << 20):
        if any(piece):
            return False
    return True


def checked_records(path: Path) -> Iterator[int]:
    """Verifies all complete records of a file, and yields the body size of each.

    Raises:
        FileNotFoundError: if the file does not exist.
        DamagedFileError: if a record is damaged.
        FileError: if a record has an unknown kind.
    """
    with path.open("rb") as file:
        for record in scan(file, 0, path.name):
            read_body(file, record, path.name)
            yield record.size


def parse_head(data: bytes, offset: int, name: str) -> Record:
    """Parses the header of the record at an offset.

    Raises:
        DamagedFileError: if the bytes are not a record header.
        FileError: if the record has an unknown kind.
    """
    head = data[: _HEAD.size]
    if len(data) < HEAD_SIZE or head[:4] != MAGIC or _CHECKSUM.unpack_from(data, _HEAD.size)[0] != zlib.crc32(head):
        raise DamagedFileError(f"{name}: no valid record at byte {offset}; the file is damaged")
    _, kind, frame, time, size, checksum = _HEAD.unpack(head)
    if kind not in RecordKind.__members__.values():
        raise FileError(
            f"{name}: unknown record kind {kind} at byte {offset}; a later version of scas4d wrote the file"
        )
    return Record(RecordKind(kind), frame, time, offset + HEAD_SIZE, size, checksum)


def read_body(file: BinaryIO, record: Record, name: str) -> bytes:
    """Reads the body of a record.

    Raises:
        DamagedFileError: if the checksum does not match, or the file ends within the body.
    """
    file.seek(record.offset)
    body = file.read(record.size)
    if len(body) != record.size or zlib.crc32(body) != record.checksum:
        about = f" of frame {record.frame}" if record.frame >= 0 else ""
        raise DamagedFileError(
            f"{name}: the {record.kind.name.lower()} record{about} at byte {record.offset - HEAD_SIZE} is damaged"
        )
    return body


def note_bytes(note: Mapping[str, Any]) -> bytes:
    """Serializes a note to a record body: the text size as u32, followed by the text as a zstandard frame.

    Args:
        note: content of the note, as JSON values.

    Raises:
        ValueError: if the note cannot be serialized as JSON, or is longer than 16 MiB.

    >>> read_note(note_bytes({"psnr": 36.5}))
    {'psnr': 36.5}
    """
    text = json.dumps(dict(note), allow_nan=False).encode()
    if len(text) > LONGEST:
        raise ValueError(f"the note has {len(text)} bytes, but the maximum is {LONGEST}")
    return len(text).to_bytes(COUNT_BYTES, "little") + compress(text)


def read_note(body: bytes) -> dict[str, Any]:
    """Parses the body of a note.

    Raises:
        PlaneError: if the body is not a note.
    """
    size = int.from_bytes(body[:COUNT_BYTES], "little")
    if len(body) <= COUNT_BYTES or size > LONGEST:
        raise PlaneError(f"invalid note of {size} bytes in a body of {len(body)} bytes")
    try:
        note = json.loads(decompress(body[COUNT_BYTES:], size))
    except (ValueError, RecursionError) as error:
        raise PlaneError(f"the note is not valid JSON ({error})") from None
    if not isinstance(note, dict):
        raise PlaneError("the note is not a JSON object")
    return note
