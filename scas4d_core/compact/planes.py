"""Integers as bytes: planes of small values, packed to 2, 4 or 8 bits with escapes, then zstandard.

A plane is one component of an attribute over all rows, mostly zeros and ones. Zstandard's Huffman coder spends a bit at
least on each byte, so values that need a fraction of a bit are packed several to a byte first.
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
"""Of zstandard: higher ones take several times as long for one to two percent."""
NARROW = (2, 4, 8)
"""Bits a value; 0 is a plane of zeros alone."""
WIDE = 16
"""Mode of a plane in two: the low bytes, and a plane of the rest."""
ESCAPE = 24
"""Bits that an escaped value takes, about: four bytes, of which one or two are not zero."""
MOST = 1 << 31
"""Values are smaller than this in size."""
_HEAD = struct.Struct("<BII")
"""Mode, escapes, bytes that follow; of a wide plane, those of its low bytes."""


class PlaneError(ValueError):
    """Bytes that are no plane of so many values."""


def pack(values: NDArray[Any]) -> bytes:
    """[N] integers, each below 2³¹ in size, as bytes that say how they are packed.

    >>> unpack(pack(np.array([0, -1, 3, 1000])), 4)[0]
    array([   0,   -1,    3, 1000], dtype=int32)
    """
    numbers = np.asarray(values)
    if len(numbers) and (int(numbers.max()) >= MOST or int(numbers.min()) <= -MOST):
        raise OverflowError(f"values of a plane are below {MOST} in size, and one of these is not")
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
    """[count] integers of a plane that begins at ``offset``, and where it ends.

    Raises:
        PlaneError: no plane of so many values is there.
    """
    unsigned, end = _unpacked(data, count, offset, 4)
    return (unsigned >> 1).view(np.int32) ^ -(unsigned & 1).view(np.int32), end


def _unpacked(data: bytes | memoryview, count: int, offset: int, wider: int) -> tuple[Unsigned, int]:
    """Values without sign; ``wider``: bytes that a value may have still."""
    if len(data) < offset + _HEAD.size:
        raise PlaneError(f"the data end at byte {len(data)}, within a plane")
    bits, escapes, size = _HEAD.unpack_from(data, offset)
    offset += _HEAD.size
    if bits == 0:
        return np.zeros(count, np.uint32), offset
    end = offset + size
    if bits not in (*NARROW, WIDE) or escapes > count or len(data) < end or wider == 0:
        raise PlaneError(f"a plane of {bits} bits, {escapes} escapes and {size} bytes cannot be at byte {offset}")
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
            raise PlaneError(f"a plane has {len(escaped)} escapes, its head says {escapes}")
        unsigned[escaped] = np.frombuffer(body, "<u4", escapes, packed)
    return unsigned, end


def compress(data: bytes) -> bytes:
    """Bytes as one frame of zstandard, which has their number."""
    return zstandard.ZstdCompressor(level=LEVEL, write_content_size=True).compress(data)


def decompress(data: bytes | memoryview, size: int) -> bytes:
    """The ``size`` bytes in a frame of zstandard.

    Raises:
        PlaneError: it has another number of bytes, or is damaged. Nothing larger is allocated.
    """
    try:
        if zstandard.frame_content_size(data) != size:
            raise PlaneError(f"{zstandard.frame_content_size(data)} bytes where {size} belong")
        content: bytes = zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
    except zstandard.ZstdError as error:
        raise PlaneError(f"not a zstandard frame ({error})") from None
    if len(content) != size:
        raise PlaneError(f"{len(content)} bytes where {size} belong")
    return content


def _bits(unsigned: Unsigned) -> int:
    """The packing that should come out smallest, by the entropy of its values and what escapes cost."""
    count = len(unsigned)
    below = np.bincount(np.minimum(unsigned, 256), minlength=257)
    costs = []
    for bits in NARROW:
        most = (1 << bits) - 1
        escapes = int(below[most:].sum())
        shares = np.append(below[:most], escapes) / count
        entropy = -float(shares[shares > 0] @ np.log2(shares[shares > 0]))
        costs.append(count * max(entropy, bits / 8) + ESCAPE * escapes)  # a byte takes a bit at least
    narrow = int(np.argmin(costs))
    wide = below[256] * 32 > count  # many are above a byte
    return WIDE if wide else NARROW[narrow]


def _joined(small: NDArray[np.uint8], bits: int) -> NDArray[np.uint8]:
    """Values of so many bits, several to a byte, the first lowest."""
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
