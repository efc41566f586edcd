"""Downloads of several arrays from device memory with a single wait."""

from __future__ import annotations

from typing import Any

import warp as wp
from numpy.typing import NDArray


class Downloads:
    """Helper that copies arrays to the host through page-locked buffers, which are reused while shapes stay the same.

    Args:
        device: Warp device, such as "cpu" or "cuda:0".

    Attributes:
        waits: number of times the host has waited for the device.
    """

    def __init__(self, device: str) -> None:
        self._device, self._staged = wp.get_device(device), dict[int, wp.array]()
        self.waits = 0

    def read(self, *arrays: wp.array) -> list[NDArray[Any]]:
        """Waits for all work enqueued so far, and returns host copies of the arrays."""
        self.waits += 1
        if not self._device.is_cuda:
            return [array.numpy().copy() for array in arrays]
        for place, array in enumerate(arrays):
            staged = self._staged.get(place)
            if staged is None or staged.shape != array.shape or staged.dtype != array.dtype:
                self._staged[place] = staged = wp.empty(array.shape, dtype=array.dtype, device="cpu", pinned=True)
            wp.copy(staged, array)
        wp.synchronize_stream(self._device)
        return [self._staged[place].numpy().copy() for place in range(len(arrays))]
