"""Values that change between iterations of a captured graph. The host writes them, and kernels read them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from scas4d_core.engines.warp.adam import SCALARS

WEIGHTS = 3
"""Number of scalars that precede the optimizer scalars: the weights of rigidity, isometry and rotation per pair."""
VIEW_COLUMNS = 3
"""Number of integers per view: index of the view, row of the log, and slot of the kept rendering."""


class StepRecords:
    """One record in device memory, which is filled from a ring buffer in host memory without waiting for the device.

    Args:
        device: Warp device.
        optimizers: number of optimizers.
        views: maximum number of views per iteration.
        rows: maximum number of pending records. The caller must wait for the device before writing more.

    Attributes:
        sample: [1] int32 index of the neighbour sample.
        iteration: [1] int32 row of the iteration in the losses.
        weights: [3] float32 weights of the neighbour terms; see ``WEIGHTS``.
    """

    def __init__(self, device: str, optimizers: int, views: int, rows: int) -> None:
        pinned = wp.get_device(device).is_cuda
        integers, scalars = 2 + VIEW_COLUMNS * views, WEIGHTS + SCALARS * optimizers
        self.rows, self._next = rows, 0
        self._integers = wp.zeros(integers, dtype=wp.int32, device=device)
        self._scalars = wp.zeros(scalars, dtype=wp.float32, device=device)
        self._integer_ring = wp.zeros((rows, integers), dtype=wp.int32, device="cpu", pinned=pinned)
        self._scalar_ring = wp.zeros((rows, scalars), dtype=wp.float32, device="cpu", pinned=pinned)
        self._host_integers, self._host_scalars = self._integer_ring.numpy(), self._scalar_ring.numpy()
        self.sample, self.iteration = self._integers[:1], self._integers[1:2]
        self.weights = self._scalars[:WEIGHTS]

    def optimizer(self, place: int) -> wp.array:
        """Returns the scalars [``SCALARS``] of the optimizer with index ``place``."""
        first = WEIGHTS + SCALARS * place
        return self._scalars[first : first + SCALARS]

    def view(self, place: int) -> tuple[wp.array, wp.array, wp.array]:
        """Returns the integers of the iteration's view with index ``place``, as [1] arrays. See ``VIEW_COLUMNS``."""
        first = 2 + VIEW_COLUMNS * place
        view, record, slot = (self._integers[k : k + 1] for k in range(first, first + VIEW_COLUMNS))
        return view, record, slot

    def write(
        self, sample: int, iteration: int, views: Sequence[tuple[int, int, int]], scalars: Sequence[float]
    ) -> None:
        """Writes a record to the ring buffer, and enqueues its upload.

        Args:
            sample: index of the neighbour sample.
            iteration: row of the iteration in the losses.
            views: integers of each view; see ``VIEW_COLUMNS``.
            scalars: weights, followed by the scalars of each optimizer.
        """
        row, self._next = self._next, (self._next + 1) % self.rows
        integers = self._host_integers[row]
        integers[:2] = sample, iteration
        integers[2 : 2 + VIEW_COLUMNS * len(views)] = np.ravel(views)
        self._host_scalars[row] = scalars
        wp.copy(self._integers, self._integer_ring[row])
        wp.copy(self._scalars, self._scalar_ring[row])
