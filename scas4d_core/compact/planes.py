"""Encodes integers as bytes: small values are packed to 2, 4 or 8 bits with escapes, then compressed with zstandard.

A plane is one component of an attribute over all rows, mostly zeros and ones. Zstandard's Huffman coder spends at least
one bit per byte, so values with less than one bit of entropy are first packed, several to a byte.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray

Ints = NDArray[np.int32]
Unsigned = NDArray[np.uint32]

LEVEL = 3
"""Zstandard compression level; higher levels take several times as long and save one to two percent."""
NARROW = (2, 4, 8)
"""Supported numbers of bits per value; 0 marks an all-zero plane."""
WIDE = 16
"""Mode of a plane that is split in two: the low bytes, and a plane of the remaining bits."""
ESCAPE = 24
"""Approximate cost of an escaped value in bits: four bytes, of which one or two are nonzero."""
MOST = 1 << 31
"""Exclusive upper bound on the absolute value of an encoded integer."""
_HEAD = struct.Struct("<BII")
"""Mode, number of escapes, and size of the following data in bytes (for a wide plane, only of its low bytes)."""


class PlaneError(ValueError):
    """Raised if bytes are not a plane with the expected number of values."""


def pack(values: NDArray[Any]) -> bytes:
    """Encodes integers [N], each below 2³¹ in absolute value, as self-describing bytes.

    Raises:
        OverflowError: if a value is too large.

    >>> unpack(pack(np.array([0, -1, 3, 1000])), 4)[0]
    array([   0,   -1,    3, 1000], dtype=int32)
    """
    numbers = np.asarray(values)
    if len(numbers) and (int(numbers.max()) >= MOST or int(numbers.min()) <= -MOST):
        raise OverflowError(f"plane values must be below {MOST} in absolute value")
    small = numbers.astype(np.int32)
    folded = np.empty(len(small), np.uint32)
    folded[:] = ((small << 1) ^ (small >> 31)).view(np.uint32)
    return _packed(folded)


def _packed(unsigned: Unsigned) -> bytes:
    if not unsigned.any():
        return _HEAD.pack(0, 0, 0)
    bits = _bits(unsigned)
    if bits == WIDE:
        squeezed = compress((unsigned & 255).astype(np.uint8).tobytes())
        return _HEAD.pack(WIDE, 0, len(squeezed)) + squeezed + _packed(unsigned >> np.uint32(8))
    most = (1 << bits) - 1
    escaped = unsigned[unsigned >= most]
    small = np.minimum(unsigned, most).astype(np.uint8)
    squeezed = compress(_joined(small, bits).tobytes() + escaped.astype("<u4").tobytes())
    return _HEAD.pack(bits, len(escaped), len(squeezed)) + squeezed


def unpack(data: bytes | memoryview, count: int, offset: int = 0) -> tuple[Ints, int]:
    """Decodes the plane at ``offset`` to integers [count]; also returns the offset of its end.

    Raises:
        PlaneError: if the bytes are not a plane with this number of values.
    """
    unsigned, end = _unpacked(data, count, offset, 4)
    return (unsigned >> 1).view(np.int32) ^ -(unsigned & 1).view(np.int32), end


def _unpacked(data: bytes | memoryview, count: int, offset: int, wider: int) -> tuple[Unsigned, int]:
    """Decodes unsigned values; ``wider`` limits the number of nested planes."""
    if len(data) < offset + _HEAD.size:
        raise PlaneError(f"unexpected end of data at byte {len(data)}, inside a plane")
    bits, escapes, size = _HEAD.unpack_from(data, offset)
    offset += _HEAD.size
    if bits == 0:
        return np.zeros(count, np.uint32), offset
    end = offset + size
    if bits not in (*NARROW, WIDE) or escapes > count or len(data) < end or wider == 0:
        raise PlaneError(f"invalid plane at byte {offset} ({bits} bits, {escapes} escapes, {size} bytes)")
    if bits == WIDE:
        low = np.frombuffer(decompress(data[offset:end], count), np.uint8)
        high, end = _unpacked(data, count, end, wider - 1)
        return low.astype(np.uint32) | (high << np.uint32(8)), end
    packed = (count * bits + 7) // 8
    body = decompress(data[offset:end], packed + 4 * escapes)
    small = _split(np.frombuffer(body, np.uint8, packed), bits, count)
    unsigned = small.astype(np.uint32)
    if escapes:
        escaped = np.flatnonzero(small == (1 << bits) - 1)
        if len(escaped) != escapes:
            raise PlaneError(f"a plane has {len(escaped)} escapes, but its header declares {escapes}")
        unsigned[escaped] = np.frombuffer(body, "<u4", escapes, packed)
    return unsigned, end


def compress(data: bytes) -> bytes:
    """Compresses bytes to one zstandard frame that records the uncompressed size."""
    return zstandard.ZstdCompressor(level=LEVEL, write_content_size=True).compress(data)


def decompress(data: bytes | memoryview, size: int) -> bytes:
    """Decompresses a zstandard frame that contains exactly ``size`` bytes, without allocating more than that.

    Raises:
        PlaneError: if the frame contains a different number of bytes, or is damaged.
    """
    try:
        if zstandard.frame_content_size(data) != size:
            raise PlaneError(f"expected {size} bytes after decompression, got {zstandard.frame_content_size(data)}")
        content: bytes = zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
    except zstandard.ZstdError as error:
        raise PlaneError(f"not a zstandard frame ({error})") from None
    if len(content) != size:
        raise PlaneError(f"expected {size} bytes after decompression, got {len(content)}")
    return content


def _bits(unsigned: Unsigned) -> int:
    """Returns the packing mode of a plane, in bits per value.

    The mode is ``WIDE`` if many values exceed a byte. Otherwise, the mode has the smallest size,
    estimated from the entropy of the values and the cost of escapes.
    """
    count = len(unsigned)
    below = np.bincount(np.minimum(unsigned, 256), minlength=257)
    costs = []
    for bits in NARROW:
        most = (1 << bits) - 1
        escapes = int(below[most:].sum())
        shares = np.append(below[:most], escapes) / count
        entropy = -float(shares[shares > 0] @ np.log2(shares[shares > 0]))
        costs.append(count * max(entropy, bits / 8) + ESCAPE * escapes)  # Huffman coding needs at least a bit per byte
    narrow = int(np.argmin(costs))
    wide = below[256] * 32 > count  # many values exceed a byte
    return WIDE if wide else NARROW[narrow]


def _joined(small: NDArray[np.uint8], bits: int) -> NDArray[np.uint8]:
    """Packs several values of ``bits`` bits into each byte, the first in the lowest bits."""
    per_byte = 8 // bits
    if per_byte == 1:
        return small
    full = np.concatenate([small, np.zeros(-len(small) % per_byte, np.uint8)]).reshape(-1, per_byte)
    joined = full[:, 0].copy()
    for place in range(1, per_byte):
        joined |= full[:, place] << np.uint8(bits * place)
    return joined


def _split(joined: NDArray[np.uint8], bits: int, count: int) -> NDArray[np.uint8]:
    per_byte = 8 // bits
    if per_byte == 1:
        return joined[:count]
    most = np.uint8((1 << bits) - 1)
    split = np.empty((len(joined), per_byte), np.uint8)
    for place in range(per_byte):
        split[:, place] = (joined >> np.uint8(bits * place)) & most
    return split.reshape(-1)[:count]
