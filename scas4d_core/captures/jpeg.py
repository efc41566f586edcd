"""Recognizes JPEG files that libjpeg always decodes, from their segments and without decoding their pixels.

libjpeg ends with an error only if a segment is invalid or missing. It replaces missing and damaged scan data by grey.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import lru_cache

SOF = (0xC0, 0xC1)
"""Frame headers of sequential JPEGs with Huffman coding."""
DHT, SOS, DQT, DRI, COM = 0xC4, 0xDA, 0xDB, 0xDD, 0xFE
LUMA_SAMPLING = (0x11, 0x12, 0x21, 0x22, 0x41)
"""Common sampling factors of the first of three components; the other two have 0x11."""
MAX_SIDE = 65500
"""Maximum width and height in libjpeg."""


def always_decodes(segments: Sequence[tuple[int, bytes]]) -> bool:
    """Returns whether a JPEG is sequential, has one scan, and contains only valid segments that libjpeg supports.

    Args:
        segments: marker and contents of each segment between the start and end markers, in order. The end marker must
            directly follow the data of the last segment, a scan.

    >>> always_decodes([(0xDB, bytes(65))])
    False
    """
    quantization: set[int] = set()
    huffman: set[int] = set()
    components = b""
    for marker, body in segments[:-1]:
        if marker in SOF:
            _, *size, count = struct.unpack(">BHHB", body[:6])
            if components or len(body) != 6 + 3 * count or not 0 < min(size) <= max(size) <= MAX_SIDE:
                return False
            components = body[6:]
        elif marker in (DQT, DHT):
            tables = _quantization_tables(body) if marker == DQT else _huffman_tables(body)
            if tables is None:
                return False
            (quantization if marker == DQT else huffman).update(tables)
        elif marker == DRI:
            if len(body) != 2:
                return False
        elif not (0xE0 <= marker <= 0xEF or marker == COM):
            return False
    if not components or segments[-1][0] != SOS:
        return False
    names, sampling = components[::3], components[1::3]
    if len(set(names)) != len(names) or not quantization.issuperset(components[2::3]):
        return False
    if sampling != b"\x11" and not (sampling[0] in LUMA_SAMPLING and sampling[1:] == b"\x11\x11"):
        return False
    return _is_sequential_scan(segments[-1][1], names, huffman)


def _is_sequential_scan(body: bytes, names: bytes, huffman: set[int]) -> bool:
    count = len(names)
    if len(body) != 4 + 2 * count or body[0] != count or body[1:-3:2] != names or body[-3:] != b"\0\x3f\0":
        return False
    return all(table >> 4 in huffman and (table & 15) | 16 in huffman for table in body[2:-3:2])


def _quantization_tables(body: bytes) -> set[int] | None:
    """Returns the indices of the tables in a segment, or None if it is invalid."""
    tables, at = set(), 0
    while at < len(body):
        precision, index = divmod(body[at], 16)
        if precision > 1 or index > 3:
            return None
        tables.add(index)
        at += 65 + 64 * precision
    return tables if at == len(body) else None


@lru_cache(64)
def _huffman_tables(body: bytes) -> frozenset[int] | None:
    """Returns the indices of the tables in a segment (AC tables plus 16), or None if it is invalid."""
    tables, at = set(), 0
    while at < len(body):
        index, counts = body[at], body[at + 1 : at + 17]
        symbols = body[at + 17 : at + 17 + sum(counts)]
        if index & 0xEF > 3 or len(counts) < 16 or not 0 < len(symbols) == sum(counts) <= 256:
            return None
        code = 0
        for length, count in enumerate(counts, 1):
            code = 2 * code + count
            if code >= 1 << length:  # more codes than this length has; all ones is reserved
                return None
        if index < 16 and max(symbols) > 15:
            return None
        tables.add(index)
        at += 17 + len(symbols)
    return frozenset(tables) if at == len(body) else None
