"""Sections of a coded state: residuals, masks and exact arrays. Decoding allocates only what the rows need."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.compact.planes import Ints, PlaneError, compress, decompress, pack, unpack

Floats = NDArray[np.float32]

SPARSE = 0.6
"""Fraction of changed rows below which only these rows are coded, with a mask."""
NONE, ALL, SOME = 0, 1, 2
"""First byte of a section: whether it has values for no rows, for all rows, or only for the rows in a mask."""
LARGEST_ARRAY = 1 << 24
"""Maximum size of an exact array in bytes."""


def write_residuals(planes: Ints, rows: NDArray[np.intp] | None = None, total: int = 0) -> bytes:
    """Encodes residuals [P, N] of an attribute, component by component, for no rows, all rows or masked rows.

    Args:
        planes: [P, N] residuals.
        rows: [N] row index of each residual, or None if every row has a residual.
        total: total number of rows, if ``rows`` is given.

    >>> planes = np.array([[0, 0, 5, 0], [0, 0, 1, 0]])
    >>> read_residuals(write_residuals(planes), 0, 2, 4)[0]
    array([[0, 0, 5, 0],
           [0, 0, 1, 0]], dtype=int32)
    """
    changed: NDArray[np.bool_] = np.any(planes, axis=0)
    if not changed.any():
        return bytes([NONE])
    every = changed
    if rows is not None:
        every = np.zeros(total, np.bool_)
        every[rows] = changed
    if np.count_nonzero(every) < SPARSE * len(every):
        return write_mask(every) + b"".join(pack(plane) for plane in planes[:, changed])
    if rows is not None:
        planes = scattered(rows, planes, total)
    return bytes([ALL]) + b"".join(pack(plane) for plane in planes)


def read_residuals(body: bytes, offset: int, components: int, rows: int) -> tuple[Ints, int]:
    """Decodes the residuals [components, rows] of a section; also returns the offset of its end. Raises PlaneError."""
    chosen, values, offset = read_coded_rows(body, offset, components, rows)
    return scattered(chosen, values, rows), offset


def scattered(rows: NDArray[np.intp], planes: Ints, total: int) -> Ints:
    """Expands the residuals [P, R] of some rows, listed in increasing order, to all rows, [P, total]; the others are 0.

    >>> scattered(np.array([1, 3]), np.array([[7, 9]]), 4)
    array([[0, 7, 0, 9]], dtype=int32)
    """
    if len(rows) == total:
        return planes
    dense = np.zeros((len(planes), total), np.int32)
    dense[:, rows] = planes
    return dense


def read_coded_rows(body: bytes, offset: int, components: int, rows: int) -> tuple[NDArray[np.intp], Ints, int]:
    """Decodes a section; returns its coded rows [R], their residuals [components, R], and the offset of its end.

    Raises:
        PlaneError: if the bytes are not a valid section.
    """
    kind, offset = _read_kind(body, offset)
    if kind == NONE:
        return np.zeros(0, np.intp), np.zeros((components, 0), np.int32), offset
    chosen = np.arange(rows)
    if kind == SOME:
        mask, offset = _read_bits(body, offset, rows)
        chosen = np.flatnonzero(mask)
    planes = np.empty((components, len(chosen)), np.int32)
    for plane in planes:
        plane[:], offset = unpack(body, len(chosen), offset)
    return chosen, planes, offset


def write_mask(mask: NDArray[np.bool_] | None) -> bytes:
    """Encodes a boolean mask [N] with one bit per entry; None means unchanged."""
    return bytes([NONE]) if mask is None else bytes([SOME]) + _sized(compress(np.packbits(mask).tobytes()))


def read_mask(body: bytes, offset: int, rows: int) -> tuple[NDArray[np.bool_] | None, int]:
    """Decodes a mask [rows], or None if it is unchanged; also returns the offset of the section's end."""
    kind, offset = _read_kind(body, offset)
    return (None, offset) if kind == NONE else _read_bits(body, offset, rows)


def _read_bits(body: bytes, offset: int, rows: int) -> tuple[NDArray[np.bool_], int]:
    data, offset = _read_sized(body, offset, (rows + 7) // 8)
    return np.unpackbits(np.frombuffer(data, np.uint8), count=rows).astype(np.bool_), offset


def write_array(array: NDArray[Any] | None) -> bytes:
    """Encodes a float32 array of any shape exactly; None means unchanged."""
    if array is None:
        return bytes([NONE])
    shape = struct.pack(f"<B{array.ndim}I", array.ndim, *array.shape)
    return bytes([ALL]) + shape + _sized(compress(array.astype("<f4").tobytes()))


def read_array(body: bytes, offset: int) -> tuple[Floats | None, int]:
    """Decodes an array, or None if it is unchanged; also returns the offset of the section's end."""
    kind, offset = _read_kind(body, offset)
    if kind == NONE:
        return None, offset
    dimensions = body[offset] if offset < len(body) else 0
    if not 0 < dimensions <= 4 or len(body) < offset + 1 + 4 * dimensions:
        raise PlaneError(f"invalid array with {dimensions} dimensions at byte {offset}")
    shape = struct.unpack_from(f"<{dimensions}I", body, offset + 1)
    size = 4
    for length in shape:
        size *= length
    if size > LARGEST_ARRAY:
        raise PlaneError(f"an array of {size} bytes is too large for a state")
    data, offset = _read_sized(body, offset + 1 + 4 * dimensions, size)
    return np.frombuffer(data, "<f4").reshape(shape).astype(np.float32), offset


def write_exact(rows: NDArray[np.intp], values: NDArray[Any]) -> bytes:
    """Encodes rows [E] and their float32 values [P, E] exactly."""
    if not len(rows):
        return bytes([NONE])
    data = rows.astype("<u4").tobytes() + values.astype("<f4").tobytes()
    return bytes([ALL]) + struct.pack("<I", len(rows)) + _sized(compress(data))


def read_exact(body: bytes, offset: int, most: int, width: int) -> tuple[NDArray[np.intp], Floats, int]:
    """Decodes the indices of exactly coded rows, each below ``most``, and their values; also returns the end offset."""
    kind, offset = _read_kind(body, offset)
    if kind == NONE:
        return np.zeros(0, np.intp), np.zeros((width, 0), np.float32), offset
    if len(body) < offset + 4:
        raise PlaneError(f"unexpected end of data at byte {len(body)}, inside a count")
    (count,) = struct.unpack_from("<I", body, offset)
    if not 0 < count <= most:
        raise PlaneError(f"invalid number of exactly coded rows: {count} (at most {most})")
    data, offset = _read_sized(body, offset + 4, 4 * count * (1 + width))
    rows = np.frombuffer(data, "<u4", count).astype(np.intp)
    if int(rows.max()) >= most:
        raise PlaneError(f"row {int(rows.max())} is out of range for {most} rows")
    values = np.frombuffer(data, "<f4", count * width, 4 * count).reshape(width, count).astype(np.float32)
    return rows, values, offset


def _read_kind(body: bytes, offset: int) -> tuple[int, int]:
    """Returns the first byte of a section, and the offset after it."""
    if offset >= len(body):
        raise PlaneError(f"unexpected end of data at byte {len(body)}, before a section")
    kind = body[offset]
    if kind not in (NONE, ALL, SOME):
        raise PlaneError(f"invalid section kind {kind} at byte {offset}")
    return kind, offset + 1


def _sized(data: bytes) -> bytes:
    return struct.pack("<I", len(data)) + data


def _read_sized(body: bytes, offset: int, size: int) -> tuple[bytes, int]:
    """Decompresses a block of ``size`` bytes; also returns the offset of the block's end."""
    if len(body) < offset + 4:
        raise PlaneError(f"unexpected end of data at byte {len(body)} while reading a size field")
    (length,) = struct.unpack_from("<I", body, offset)
    if len(body) < offset + 4 + length:
        raise PlaneError(
            f"a block of {length} bytes at byte {offset + 4} extends beyond the end of the data ({len(body)} bytes)"
        )
    return decompress(body[offset + 4 : offset + 4 + length], size), offset + 4 + length
