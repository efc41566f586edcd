"""Device copies of host arrays that several calls use, such as the arrays of Θ_{t−1}."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from scas4d_core.gaussians import Gaussians

MOST = 32
"""Maximum number of copies per device: the arrays of about ten states."""


class DeviceCopies:
    """Cache of the most recently used device copies of host arrays, which avoids repeated uploads.

    A host array becomes read-only when a copy of it is stored, because the copy would not reflect later changes.
    Writable views of parts of other arrays are uploaded on each call. Callers must not modify the copies.

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
            copy = wp.array(np.ascontiguousarray(compute()), dtype=dtype, device=self._device)
            self.store(copy, *sources)
            return copy
        self._copies[key] = entry
        return entry[1]

    def store(self, copy: wp.array, *sources: NDArray[Any]) -> None:
        """Stores a device array as the copy of an array, or of the array derived from several sources."""
        if not all(_can_freeze(source) for source in sources):
            return
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


@cache
def copies_on(device: str) -> DeviceCopies:
    """Returns the cache of copies on a device, which all engines and renderers of this process share."""
    return DeviceCopies(device)


def features_on(copies: DeviceCopies, state: Gaussians) -> wp.array:
    """Returns a state's features, [N] vec4: the colours without gloss, and the labels."""
    return copies.derived(lambda: state.features(state.colours), wp.vec4, state.colours, state.foreground)


def as_numbers(rows: wp.array) -> wp.array:
    """Returns a [N, C] float32 view of N contiguous vectors or matrices of C numbers, without copying."""
    shape = rows.shape[0], wp.types.type_size(rows.dtype)
    return wp.array(ptr=rows.ptr, dtype=wp.float32, shape=shape, device=rows.device)
