"""Downloads of several arrays from device memory with a single wait."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

import warp as wp
from numpy.typing import NDArray

MOST = 32
"""Maximum number of page-locked buffers of one instance. A frame downloads about 20 different arrays."""


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
        if not self._device.is_cuda:
            return [array.numpy().copy() for array in arrays]
        buffers = [self._buffer(place, array) for place, array in enumerate(arrays)]
        for buffer, array in zip(buffers, arrays, strict=True):
            wp.copy(buffer, array)
        wp.synchronize_stream(self._device)
        return [buffer.numpy().copy() for buffer in buffers]

    def _buffer(self, place: int, array: wp.array) -> wp.array:
        """Returns the buffer for an array at a place among the arguments of ``read``."""
        key = place, array.shape, array.dtype
        buffer = self._buffers.pop(key, None)
        if buffer is None:
            buffer = wp.empty(array.shape, dtype=array.dtype, device="cpu", pinned=True)
        self._buffers[key] = buffer
        while len(self._buffers) > MOST:
            self._buffers.popitem(last=False)
        return buffer
