"""Records of a compact file: a head with checksum, so that a file is listed without its bodies, and a body with one.

A file is read while it is written: what is not whole at its end is not there yet. Earlier damage is reported with
its place.
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
"""First bytes of each record; of the file, too."""
_HEAD = struct.Struct("<4sB3xqdII")
"""Magic, kind, frame, time in seconds, bytes of the body, CRC-32 of the body; then the CRC-32 of these."""
_CHECKSUM = struct.Struct("<I")
HEAD_SIZE = _HEAD.size + _CHECKSUM.size
COUNT_BYTES = 4
LONGEST = 1 << 24
"""Bytes of a note's text at most: what a damaged file asks for must not fill the memory."""


class RecordKind(IntEnum):
    """Kinds of records, by what their body holds."""

    HEAD = 1
    """JSON: version, world, bounds."""
    BORN = 2
    """Gaussians without a reference: those of the first frame, or born in this one."""
    KEY = 3
    """A key state, coded against the newborn Gaussians."""
    DELTA = 4
    """A state, coded against the one before."""
    PARTS = 5
    """A part of each Gaussian."""
    INDEX = 6
    """Where all records are; the last."""
    NOTE = 7
    """JSON about the frame whose state follows."""


class FileError(ValueError):
    """A file that is no compact file, or of another version; the message names the file and the fault."""


class FormatError(FileError):
    """A compact file of another version of the format; it stays as it is."""


class DamagedFileError(FileError):
    """A compact file with damaged bytes; the message names the file and the place."""


@dataclass(frozen=True)
class Record:
    """Place of a record in a file.

    Attributes:
        kind: of its body. frame: index, −1 for none. time: seconds. offset: of its body in the file. size: of the body,
            bytes. checksum: CRC-32 of the body.
    """

    kind: RecordKind
    frame: int
    time: float
    offset: int
    size: int
    checksum: int

    @property
    def end(self) -> int:
        """Of its body, in the file."""
        return self.offset + self.size

    def at(self, offset: int) -> Record:
        """The record in a file, where its head begins at an offset."""
        return replace(self, offset=offset + HEAD_SIZE)


def record_bytes(kind: RecordKind, body: bytes, frame: int = -1, time: float = 0.0) -> bytes:
    """A record.

    >>> import io
    >>> file = io.BytesIO(record_bytes(RecordKind.KEY, b"abc", 7, 0.5))
    >>> (found,) = scan(file, 0, "a file")
    >>> found.kind.name, found.frame, read_body(file, found, "a file")
    ('KEY', 7, b'abc')
    """
    head = _HEAD.pack(MAGIC, kind, frame, time, len(body), zlib.crc32(body))
    return head + _CHECKSUM.pack(zlib.crc32(head)) + body


def checksum_bytes(record: Record) -> bytes:
    """The checksum of a record's body, as a delta begins with that of the state before."""
    return _CHECKSUM.pack(record.checksum)


def scan(file: BinaryIO, offset: int, name: str) -> Iterator[Record]:
    """The whole records from an offset on; the rest of one that is not whole is not there yet.

    Args:
        name: of the file, for errors.

    Raises:
        DamagedFileError: bytes that are no record stand where one begins.
    """
    file.seek(0, 2)
    size = file.tell()
    while offset + HEAD_SIZE <= size:
        file.seek(offset)
        data = file.read(HEAD_SIZE)
        if not any(data) and _is_zero(file):  # a power cut came before the bytes, and after the length of the file
            return
        record = parse_head(data, offset, name)
        if record.end > size:
            return
        yield record
        offset = record.end


def _is_zero(file: BinaryIO) -> bool:
    """True where only zeros follow."""
    while piece := file.read(1 << 20):
        if any(piece):
            return False
    return True


def checked_records(path: Path) -> Iterator[int]:
    """Reads all whole records of a file, and yields the bytes of each.

    Raises:
        FileNotFoundError: it is not there. DamagedFileError: a record is damaged.
    """
    with path.open("rb") as file:
        for record in scan(file, 0, path.name):
            read_body(file, record, path.name)
            yield record.size


def parse_head(data: bytes, offset: int, name: str) -> Record:
    """The record whose head stands at an offset.

    Raises:
        DamagedFileError: it is none.
    """
    head = data[: _HEAD.size]
    if len(data) < HEAD_SIZE or head[:4] != MAGIC or _CHECKSUM.unpack_from(data, _HEAD.size)[0] != zlib.crc32(head):
        raise DamagedFileError(f"{name}: no record begins at byte {offset}; the file is damaged there")
    _, kind, frame, time, size, checksum = _HEAD.unpack(head)
    if kind not in RecordKind.__members__.values():
        raise FileError(f"{name}: a record of kind {kind} is at byte {offset}; a later version of scas4d wrote it")
    return Record(RecordKind(kind), frame, time, offset + HEAD_SIZE, size, checksum)


def read_body(file: BinaryIO, record: Record, name: str) -> bytes:
    """The body of a record.

    Raises:
        DamagedFileError: it fails its checksum, or the file ends within it.
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
    """The body of a note: u32 bytes of the text, then the text as a zstandard frame.

    Args:
        note: JSON values.

    Raises:
        ValueError: it is not valid JSON, or longer than 16 MB.

    >>> read_note(note_bytes({"psnr": 36.5}))
    {'psnr': 36.5}
    """
    text = json.dumps(dict(note), allow_nan=False).encode()
    if len(text) > LONGEST:
        raise ValueError(f"a note of {len(text)} bytes is too long; {LONGEST} are the most")
    return len(text).to_bytes(COUNT_BYTES, "little") + compress(text)


def read_note(body: bytes) -> dict[str, Any]:
    """The note in a body.

    Raises:
        PlaneError: there is none.
    """
    size = int.from_bytes(body[:COUNT_BYTES], "little")
    if len(body) <= COUNT_BYTES or size > LONGEST:
        raise PlaneError(f"a note of {size} bytes in {len(body)}")
    try:
        note = json.loads(decompress(body[COUNT_BYTES:], size))
    except (ValueError, RecursionError) as error:
        raise PlaneError(f"the note is not valid JSON ({error})") from None
    if not isinstance(note, dict):
        raise PlaneError("the note is not a JSON object")
    return note
