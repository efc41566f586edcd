"""Downloads of several arrays from device memory with a single wait."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

import warp as wp
from numpy.typing import NDArray

MOST_BYTES = 2**28
"""Size in bytes up to which page-locked buffers are kept, besides those of the current download."""


class Downloads:
    """Helper that copies arrays to the host through page-locked buffers, which are reused for the same shapes.

    Args:
        device: Warp device, such as "cpu" or "cuda:0".

    Attributes:
        waits: number of times the host has waited for the device.
    """

    def __init__(self, device: str) -> None:
        self._device, self._buffers = wp.get_device(device), OrderedDict[tuple[Any, ...], wp.array]()
        self.waits = 0

    def read(self, *arrays: wp.array) -> list[NDArray[Any]]:
        """Waits for all work enqueued so far, and returns host copies of the arrays."""
        self.waits += 1
        buffers = [self._buffer(place, array) for place, array in enumerate(arrays)]
        for buffer, array in zip(buffers, arrays, strict=True):
            wp.copy(buffer, array)
        wp.synchronize_stream(self._device)
        copies = [buffer.numpy().copy() for buffer in buffers]
        while self.kept_bytes > MOST_BYTES:
            self._buffers.popitem(last=False)
        return copies

    @property
    def kept_bytes(self) -> int:
        """Size of all kept buffers in bytes."""
        return sum(buffer.capacity for buffer in self._buffers.values())

    def _buffer(self, place: int, array: wp.array) -> wp.array:
        """Returns the buffer for an array at a place among the arguments of ``read``."""
        key = place, array.shape, array.dtype
        buffer = self._buffers.pop(key, None)
        if buffer is None:
            buffer = wp.empty(array.shape, dtype=array.dtype, device="cpu", pinned=self._device.is_cuda)
        self._buffers[key] = buffer
        return buffer
