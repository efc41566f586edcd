"""Uploads of host arrays, and device copies of those that several calls use, such as the arrays of Θ_{t−1}."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from scas4d_core.gaussians import Gaussians

wp.set_module_options({"enable_backward": False})

MOST = 32
"""Maximum number of copies per device: the arrays of about ten states."""
MISSING = 65535
"""Value that stands for the index −1 in an upload of 16-bit indices."""


@wp.kernel
def widen(narrow: wp.array[wp.uint16], wide: wp.array[wp.int32]) -> None:
    """Converts 16-bit indices to 32 bits, with one thread per index."""
    i = wp.tid()
    value = wp.int32(narrow[i])
    wide[i] = wp.where(value == MISSING, -1, value)


def upload(values: NDArray[Any], dtype: object, device: str) -> wp.array:
    """Uploads an array. Indices that fit are uploaded as 16 bits each, because uploads are slower than kernels.

    Args:
        values: host array of N rows.
        dtype: Warp type of a row. Values of type ``wp.int32`` must be indices of −1 or more.
        device: Warp device, such as "cpu" or "cuda:0".
    """
    if dtype is not wp.int32 or not values.size or values.max() >= MISSING:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)
    narrow = wp.array(values.ravel().astype(np.uint16), dtype=wp.uint16, device=device)  # −1 becomes ``MISSING``
    wide = wp.empty(values.size, dtype=wp.int32, device=device)
    wp.launch(widen, values.size, [narrow, wide], device=device)
    return wide.reshape(values.shape)


class DeviceCopies:
    """Cache of the most recently used device copies of host arrays, which avoids repeated uploads.

    Rows that a stored array begins with are copied on the device: if Gaussians are added, only their rows are uploaded.
    A host array becomes read-only when a copy of it is stored, because the copy would not reflect later changes.
    Writable views of parts of other arrays are compared with what they were. Callers must not modify the copies.

    Args:
        device: Warp device, such as "cpu" or "cuda:0".
        most: maximum number of copies.
    """

    def __init__(self, device: str, most: int = MOST) -> None:
        self._device, self._most = device, most
        self._copies: OrderedDict[tuple[Any, ...], tuple[tuple[NDArray[Any], ...], wp.array]] = OrderedDict()

    def of(self, array: NDArray[Any], dtype: object) -> wp.array:
        """Returns a device copy of an array.

        Args:
            array: host array of N rows.
            dtype: Warp type of a row, such as ``wp.vec3``.
        """
        return self.derived(lambda: array, dtype, array)

    def derived(self, compute: Callable[[], NDArray[Any]], dtype: object, *sources: NDArray[Any]) -> wp.array:
        """Returns a device copy of an array that is computed from other arrays.

        Args:
            compute: function that returns the array [N, …]; only called if no copy is stored.
            dtype: Warp type of a row.
            sources: arrays that determine the result.
        """
        key = self._key(dtype, sources)
        entry = self._copies.pop(key, None)
        if entry is None:
            copy = self._upload(compute(), dtype, sources)
            self.store(copy, *sources)
            return copy
        self._copies[key] = entry
        return entry[1]

    def _upload(self, values: NDArray[Any], dtype: object, sources: tuple[NDArray[Any], ...]) -> wp.array:
        """Uploads the rows of an array, except for the first ones if stored arrays begin with the same rows."""
        known = wp.empty(0, dtype=dtype, device=self._device)
        for stored_sources, stored in self._copies.values():
            rows = min(len(stored), len(values))
            if rows <= len(known) or stored.dtype is not dtype or len(stored_sources) != len(sources):
                continue
            if all(_begin_alike(*pair, rows) for pair in zip(sources, stored_sources, strict=True)):
                known = stored[:rows]
        rows = len(known)
        if rows == len(values) or not rows:
            return known if rows else upload(values, dtype, self._device)
        copy = wp.empty((len(values), *known.shape[1:]), dtype=dtype, device=self._device)
        wp.copy(copy[:rows], known)
        wp.copy(copy[rows:], upload(values[rows:], dtype, self._device))
        return copy

    def store(self, copy: wp.array, *sources: NDArray[Any]) -> None:
        """Stores a device array as the copy of an array, or of the array derived from several sources."""
        sources = tuple(source if _can_freeze(source) else source.copy() for source in sources)
        for source in sources:
            source.flags.writeable = False
            if isinstance(source.base, np.ndarray):
                source.base.flags.writeable = False
        self._copies[self._key(copy.dtype, sources)] = sources, copy  # the reference keeps the ids unique
        while len(self._copies) > self._most:
            self._copies.popitem(last=False)

    @staticmethod
    def _key(dtype: object, sources: tuple[NDArray[Any], ...]) -> tuple[Any, ...]:
        return (dtype, *(id(source) for source in sources))


def _can_freeze(array: NDArray[Any]) -> bool:
    """Returns whether an array is read-only, or can be made read-only because no larger array shares its memory."""
    base = array.base
    if base is None or not array.flags.writeable:
        return True
    return isinstance(base, np.ndarray) and base.base is None and base.nbytes == array.nbytes


def _begin_alike(first: NDArray[Any], second: NDArray[Any], rows: int) -> bool:
    """Returns whether two arrays begin with the same rows. Most that do not already differ in the first row."""
    if first.dtype != second.dtype or first.shape[1:] != second.shape[1:] or min(len(first), len(second)) < rows:
        return False
    return all(np.array_equal(first[part], second[part]) for part in (slice(1), slice(rows)))


@cache
def copies_on(device: str) -> DeviceCopies:
    """Returns the cache of copies on a device, which all engines and renderers of this process share."""
    return DeviceCopies(device)


@cache
def structures_on(device: str) -> DeviceCopies:
    """Returns another such cache, for arrays that only change if Gaussians are added or clusters are rebuilt.

    They would not stay in the cache of the states, because no frame in between uses them.
    """
    return DeviceCopies(device)


def features_on(copies: DeviceCopies, state: Gaussians) -> wp.array:
    """Returns a state's features, [N] vec4: the colours without gloss, and the labels."""
    return copies.derived(lambda: state.features(state.colours), wp.vec4, state.colours, state.foreground)


def as_numbers(rows: wp.array) -> wp.array:
    """Returns a [N, C] float32 view of N contiguous vectors or matrices of C numbers, without copying."""
    shape = rows.shape[0], wp.types.type_size(rows.dtype)
    return wp.array(ptr=rows.ptr, dtype=wp.float32, shape=shape, device=rows.device)
