"""The index at the end of a compact file, which lists the offsets of all records."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from typing import Any, BinaryIO

import numpy as np
import zstandard

from scas4d_core.compact.planes import compress, decompress
from scas4d_core.compact.records import HEAD_SIZE, Record, RecordKind, parse_head, read_body

FOOTER_MAGIC = b"s4dINDEX"
_FOOTER = struct.Struct("<Q8s")
"""Last bytes of the file: offset of the index record, and magic bytes."""
_COUNT = struct.Struct("<I")
NO_INDEX = (ValueError, TypeError, OverflowError, RecursionError, struct.error, zstandard.ZstdError)
"""Exceptions raised when parsing an invalid index; the reader then scans the records instead."""
_ROW = np.dtype(
    [("kind", "u1"), ("frame", "<i8"), ("time", "<f8"), ("offset", "<u8"), ("size", "<u4"), ("checksum", "<u4")]
)


def index_body(records: Sequence[Record], about: bytes) -> bytes:
    """Returns the body of an index: record count, table of records, and JSON about the whole file."""
    rows = [(one.kind, one.frame, one.time, one.offset, one.size, one.checksum) for one in records]
    return _COUNT.pack(len(rows)) + compress(np.array(rows, _ROW).tobytes() + about)


def footer(offset: int) -> bytes:
    """Returns the last bytes of a file whose index starts at the given offset."""
    return _FOOTER.pack(offset, FOOTER_MAGIC)


def read_index(file: BinaryIO, name: str) -> tuple[list[Record], dict[str, Any]] | None:
    """Returns a file's records and the JSON values about the file, or None if the index is missing or damaged."""
    size = file.seek(0, 2)
    if size < _FOOTER.size + HEAD_SIZE:
        return None
    file.seek(size - _FOOTER.size)
    offset, magic = _FOOTER.unpack(file.read(_FOOTER.size))
    if magic != FOOTER_MAGIC or offset + HEAD_SIZE + _FOOTER.size > size:
        return None
    try:
        file.seek(offset)
        record = parse_head(file.read(HEAD_SIZE), offset, name)
        if record.kind is not RecordKind.INDEX or record.end + _FOOTER.size != size:
            return None
        body = read_body(file, record, name)
        return _parsed(body, offset)
    except NO_INDEX:
        return None


def _parsed(body: bytes, end: int) -> tuple[list[Record], dict[str, Any]] | None:
    (count,) = _COUNT.unpack_from(body)
    size = zstandard.frame_content_size(body[_COUNT.size :])
    if not count * _ROW.itemsize <= size <= end:  # the table cannot be longer than the records it lists
        return None
    data = decompress(body[_COUNT.size :], size)
    rows = np.frombuffer(data, _ROW, count)
    if (rows["offset"] > end).any() or (rows["offset"] + rows["size"].astype(np.uint64) > end).any():
        return None
    records = [
        Record(RecordKind(int(kind)), int(frame), float(time), int(offset), int(size), int(checksum))
        for kind, frame, time, offset, size, checksum in rows.tolist()
    ]
    about = json.loads(data[count * _ROW.itemsize :] or b"{}")
    return (records, about) if isinstance(about, dict) else None
