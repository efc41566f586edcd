"""Adam (Kingma and Ba 2015) over device tables; reference: ``torch.optim.Adam``, guards: ``kernels.adam``.

A kernel that computes the gradient of an element also steps it, by calling ``step_element``. This saves launches, and
the gradient need not be read again.
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
"""Guards that ``step_element`` counts."""
SCALARS = 3
"""Scalars of a step: factor on all rates, 1 − β₁^steps and 1 − β₂^steps."""


@wp.struct
class Adam:
    """Device side of an optimizer for one table [n, columns].

    Attributes:
        columns: [columns] learning rates. by_row: [n] or [1] factor on each row's rates.
        first, second: [n, columns] moments. guard_counts: [2] see ``COUNTED_GUARDS``; counts are added.
        scalars: [``SCALARS``] of the current iteration. beta1, beta2: decay rates.
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
    """Steps one element of a table; an element with rate 0 and its moments are unchanged."""
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
    """Steps a table [n, columns] with gradients of the same shape, with one thread per element."""
    i, k = wp.tid()
    step_element(adam, table, i, k, gradients[i, k])


class Optimizer:
    """Host side of an optimizer: allocates its arrays, and counts its steps.

    Args:
        shape: of the table. scalars: [``SCALARS``] on the device, which the caller fills before each step.
        varies_by_row: whether the rates differ between rows.

    Attributes:
        adam: argument of the kernels that step the table. steps: number of steps so far.
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
        """Starts an attempt with zero moments.

        Args:
            columns: learning rate of each column. betas: decay rates of the moments.
            by_row: [n] factor on each row's rates; None keeps the previous factors.
        """
        self.steps = 0
        self.adam.beta1, self.adam.beta2 = betas
        self.adam.columns.assign(np.asarray(columns, np.float32))
        if by_row is not None:
            self.adam.by_row.assign(by_row)
        for array in (self.adam.first, self.adam.second, self.adam.guard_counts):
            array.zero_()

    def next_scalars(self, factor: float) -> tuple[float, float, float]:
        """Returns the scalars of the next step; a factor of 0 skips the step and leaves the moments unchanged."""
        if factor == 0:
            return 0.0, 1.0, 1.0
        self.steps += 1
        return factor, 1 - self.adam.beta1**self.steps, 1 - self.adam.beta2**self.steps

    def load(self, first: NDArray[np.float32], second: NDArray[np.float32], steps: int) -> None:
        """Continues from given moments."""
        self.adam.first.assign(first)
        self.adam.second.assign(second)
        self.steps = steps

    def set_columns(self, columns: NDArray[np.float32]) -> None:
        """Changes the learning rate of each column."""
        self.adam.columns.assign(columns)
