"""Adam (Kingma and Ba 2015) over device tables; reference: ``torch.optim.Adam``, guards: ``kernels.adam``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp
from numpy.typing import NDArray

from scas4d_core.guards import ADAM_EPSILON, GRADIENT_CEILING, MOMENT_FLOOR, GuardCounts

wp.set_module_options({"enable_backward": False})

EPSILON = wp.constant(wp.float32(ADAM_EPSILON))
SMALLEST = wp.constant(wp.float32(MOMENT_FLOOR))
LARGEST = wp.constant(wp.float32(GRADIENT_CEILING))
COUNTED_GUARDS = ("gradient_ceiling", "moment_floor")
"""Guards that ``step_table`` counts."""


@wp.kernel
def step_table(
    gradients: wp.array2d[wp.float32],
    columns: wp.array[wp.float32],
    by_row: wp.array[wp.float32],
    factor: wp.float32,
    beta1: wp.float32,
    beta2: wp.float32,
    correction1: wp.float32,
    correction2: wp.float32,
    first: wp.array2d[wp.float32],
    second: wp.array2d[wp.float32],
    table: wp.array2d[wp.float32],
    guard_counts: wp.array[wp.int32],
) -> None:
    """Updates a table [n, columns] with one thread per element; elements with rate 0 and their moments are unchanged.

    Args:
        gradients: [n, ≥ columns]. columns: learning rate of each column. by_row: [n] or [1] factor on each row's rates.
        factor: factor on all rates. beta1, beta2: decay rates. correction1, correction2: 1 − β^steps.
        first, second: moments. table: updated. guard_counts: [2] see ``COUNTED_GUARDS``; counts are added.
    """
    i, k = wp.tid()
    row = by_row[0]
    if by_row.shape[0] > 1:
        row = by_row[i]
    rate = columns[k] * row * factor
    if rate > 0.0:
        g = gradients[i, k]
        size = wp.abs(g)
        if not (size <= LARGEST):  # also true for NaN
            g = wp.where(g > 0.0, LARGEST, wp.where(g < 0.0, -LARGEST, 0.0))
            wp.atomic_add(guard_counts, 0, 1)
        elif size > 0.0 and size <= SMALLEST:
            g = wp.float32(0.0)
            wp.atomic_add(guard_counts, 1, 1)
        m = beta1 * first[i, k] + (1.0 - beta1) * g
        v = beta2 * second[i, k] + (1.0 - beta2) * g * g
        m = wp.where(wp.abs(m) > SMALLEST, m, 0.0)
        v = wp.where(v > SMALLEST * SMALLEST, v, 0.0)
        first[i, k] = m
        second[i, k] = v
        table[i, k] = table[i, k] - rate * (m / correction1) / (wp.sqrt(v / correction2) + EPSILON)


class Adam:
    """Adam over one table on the device.

    Args:
        table: [n, columns] float32, updated in place. columns: learning rate of each column.
        betas: decay rates of the two moments, which start at zero. by_row: [n] factor on each row's rates; None: 1.
    """

    def __init__(
        self,
        table: wp.array,
        columns: Sequence[float],
        betas: tuple[float, float],
        by_row: NDArray[np.float32] | None = None,
    ) -> None:
        device = table.device
        self._table, self._betas, self._steps = table, betas, 0
        self._shape = table.shape[0], len(columns)
        self._columns = wp.array(np.asarray(columns, np.float32), dtype=wp.float32, device=device)
        rows = np.ones(1, np.float32) if by_row is None else by_row
        self._by_row = wp.array(rows, dtype=wp.float32, device=device)
        self._first, self._second = (wp.zeros(self._shape, dtype=wp.float32, device=device) for _ in range(2))
        self._guard_counts = wp.zeros(len(COUNTED_GUARDS), dtype=wp.int32, device=device)

    def step(self, gradients: wp.array, factor: float) -> None:
        """Performs one optimization step.

        Args:
            gradients: [n, ≥ columns]. factor: factor on all rates; 0 skips the step and leaves the moments unchanged.
        """
        if factor == 0 or self._shape[0] == 0:
            return
        self._steps += 1
        beta1, beta2 = self._betas
        corrections = 1 - beta1**self._steps, 1 - beta2**self._steps
        inputs = [gradients, self._columns, self._by_row, factor, beta1, beta2, *corrections]
        inputs += [self._first, self._second, self._table, self._guard_counts]
        wp.launch(step_table, self._shape, inputs, device=self._table.device)

    def guards(self) -> GuardCounts:
        """Returns the number of times that each guard was triggered; waits for the device."""
        counts = GuardCounts(*COUNTED_GUARDS)
        counts.add(COUNTED_GUARDS, self._guard_counts.numpy().astype(np.int64))
        return counts
