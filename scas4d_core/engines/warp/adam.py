"""Adam (Kingma and Ba 2015) for tables on the device, with the guards of ``kernels.adam``.

The kernel that computes an element's gradient also updates the element, by calling ``step_element``. This saves a
kernel launch and another read of the gradient. Reference: ``torch.optim.Adam``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp
from numpy.typing import NDArray

from scas4d_core.guards import ADAM_EPSILON, GRADIENT_CEILING, MOMENT_FLOOR

wp.set_module_options({"enable_backward": False})

EPSILON = wp.constant(wp.float32(ADAM_EPSILON))
SMALLEST = wp.constant(wp.float32(MOMENT_FLOOR))
LARGEST = wp.constant(wp.float32(GRADIENT_CEILING))
COUNTED_GUARDS = ("gradient_ceiling", "moment_floor")
"""Names of the guards that ``step_element`` counts."""
SCALARS = 3
"""Number of scalars per step: learning rate factor, 1 − β₁^steps and 1 − β₂^steps."""
IDLE = 0.0, 1.0, 1.0
"""Scalars that make an optimizer skip a step."""


@wp.struct
class Adam:
    """Device-side state of the optimizer for one table [n, columns].

    Attributes:
        columns: [columns] learning rate of each column.
        by_row: learning rate factors, [n] (one per row) or [1] (one for all rows).
        first, second: [n, columns] first and second moments.
        guard_counts: [2] number of times each guard in ``COUNTED_GUARDS`` was triggered, accumulated.
        scalars: [``SCALARS``] scalars of the current step.
        beta1, beta2: decay rates of the moments.
    """

    columns: wp.array[wp.float32]
    by_row: wp.array[wp.float32]
    first: wp.array2d[wp.float32]
    second: wp.array2d[wp.float32]
    guard_counts: wp.array[wp.int32]
    scalars: wp.array[wp.float32]
    beta1: wp.float32
    beta2: wp.float32


@wp.func
def step_element(adam: Adam, table: wp.array2d[wp.float32], i: wp.int32, k: wp.int32, gradient: wp.float32) -> None:
    """Takes an Adam step for one element of a table. If its learning rate is 0, element and moments stay unchanged."""
    row = adam.by_row[0]
    if adam.by_row.shape[0] > 1:
        row = adam.by_row[i]
    rate = adam.columns[k] * row * adam.scalars[0]
    if rate > 0.0:
        g = gradient
        size = wp.abs(g)
        if not (size <= LARGEST):  # also true for NaN
            g = wp.where(g > 0.0, LARGEST, wp.where(g < 0.0, -LARGEST, 0.0))
            wp.atomic_add(adam.guard_counts, 0, 1)
        elif size > 0.0 and size <= SMALLEST:
            g = wp.float32(0.0)
            wp.atomic_add(adam.guard_counts, 1, 1)
        m = adam.beta1 * adam.first[i, k] + (1.0 - adam.beta1) * g
        v = adam.beta2 * adam.second[i, k] + (1.0 - adam.beta2) * g * g
        m = wp.where(wp.abs(m) > SMALLEST, m, 0.0)
        v = wp.where(v > SMALLEST * SMALLEST, v, 0.0)
        adam.first[i, k] = m
        adam.second[i, k] = v
        table[i, k] = table[i, k] - rate * (m / adam.scalars[1]) / (wp.sqrt(v / adam.scalars[2]) + EPSILON)


@wp.kernel
def step_table(adam: Adam, gradients: wp.array2d[wp.float32], table: wp.array2d[wp.float32]) -> None:
    """Takes an Adam step for a table [n, columns], with gradients of the same shape and one thread per element."""
    i, k = wp.tid()
    step_element(adam, table, i, k, gradients[i, k])


class Optimizer:
    """Host-side part of an optimizer, which allocates the device arrays and counts the steps.

    Args:
        shape: shape of the table.
        scalars: [``SCALARS``] device array that the caller fills before each step.
        varies_by_row: whether learning rates differ between rows.

    Attributes:
        adam: device-side state, passed to the kernels that update the table.
        steps: number of steps so far.
    """

    def __init__(self, shape: tuple[int, int], scalars: wp.array, varies_by_row: bool = False) -> None:
        device = scalars.device
        self.adam, self.steps = Adam(), 0
        self.adam.columns = wp.zeros(shape[1], dtype=wp.float32, device=device)
        self.adam.by_row = wp.ones(shape[0] if varies_by_row else 1, dtype=wp.float32, device=device)
        self.adam.first, self.adam.second = (wp.zeros(shape, dtype=wp.float32, device=device) for _ in range(2))
        self.adam.guard_counts = wp.zeros(len(COUNTED_GUARDS), dtype=wp.int32, device=device)
        self.adam.scalars = scalars

    def begin(
        self, columns: Sequence[float], betas: tuple[float, float], by_row: NDArray[np.float32] | None = None
    ) -> None:
        """Resets the moments to zero and sets the learning rates of a new attempt.

        Args:
            columns: learning rate of each column.
            betas: decay rates of the moments.
            by_row: [n] learning rate factor of each row, or None to keep the previous factors.
        """
        self.steps = 0
        self.adam.beta1, self.adam.beta2 = betas
        self.adam.columns.assign(np.asarray(columns, np.float32))
        if by_row is not None:
            self.adam.by_row.assign(by_row)
        for array in (self.adam.first, self.adam.second, self.adam.guard_counts):
            array.zero_()

    def next_scalars(self, factor: float) -> tuple[float, float, float]:
        """Returns the next step's scalars. A factor of 0 skips the step and leaves the moments unchanged."""
        if factor == 0:
            return IDLE
        self.steps += 1
        return factor, 1 - self.adam.beta1**self.steps, 1 - self.adam.beta2**self.steps

    def load(self, first: NDArray[np.float32], second: NDArray[np.float32], steps: int) -> None:
        """Loads moments and a step count, from which the optimizer continues."""
        self.adam.first.assign(first)
        self.adam.second.assign(second)
        self.steps = steps

    def set_columns(self, columns: NDArray[np.float32]) -> None:
        """Sets the learning rate of each column."""
        self.adam.columns.assign(columns)
