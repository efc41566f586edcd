"""Adam optimizers for the parameter tables of an update."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scas4d_core.guards import GuardCounts
from scas4d_core.kernels.adam import COUNTED_GUARDS, EVERY_ROW, adam

Array = NDArray[np.float32]


class Adam:
    """Adam optimizer for one parameter table, with a learning rate per column and an optional factor per row.

    Args:
        parameters: [n, columns] float32 parameters, updated in place.
        columns: learning rate of each column.
        betas: decay rates of the first and second moments, which are initialized to zero.
        by_row: [n] learning rate factor of each row.

    Attributes:
        guards: number of times each guard was triggered.
    """

    def __init__(
        self, parameters: Array, columns: Sequence[float], betas: tuple[float, float], by_row: Array = EVERY_ROW
    ) -> None:
        self._parameters = parameters
        self._by_row = by_row
        self._first, self._second = np.zeros_like(parameters), np.zeros_like(parameters)
        self._rates = np.array(columns, np.float32)
        self._beta1, self._beta2 = np.float32(betas[0]), np.float32(betas[1])
        self._steps = 0
        self.guards = GuardCounts(*COUNTED_GUARDS)

    def step(self, gradients: Array, factor: float) -> None:
        """Performs one optimization step.

        Args:
            gradients: [n, columns] gradients of the parameters.
            factor: factor that scales all learning rates. If it is 0, the step is skipped and the moments remain
                unchanged.
        """
        if factor == 0:
            return
        self._steps += 1
        guard_counts = adam(
            self._parameters, gradients, self._first, self._second, self._rates * np.float32(factor), self._by_row,
            self._beta1, self._beta2, self._steps,
        )  # fmt: skip
        self.guards.add(COUNTED_GUARDS, guard_counts)


class AdamColumns:
    """Adam optimizer for the columns of a table that have a positive learning rate. Other columns are not updated.

    Args:
        table: [n, columns] parameters, updated in place. No other code may modify them.
        columns: learning rate of each column. At least one must be positive.
        betas: see ``Adam``.
    """

    def __init__(self, table: Array, columns: Sequence[float], betas: tuple[float, float]) -> None:
        self._table = table
        self._free = np.flatnonzero(columns)
        # The kernel requires contiguous rows, so a subset of the columns is updated in a copy.
        self._values = table if len(self._free) == len(columns) else np.take(table, self._free, axis=1)
        self._adam = Adam(self._values, [rate for rate in columns if rate], betas)
        self.guards: GuardCounts = self._adam.guards

    def step(self, gradients: Array, factor: float) -> None:
        """Performs one optimization step; see ``Adam.step``."""
        if self._values is self._table:
            self._adam.step(gradients, factor)
            return
        self._adam.step(np.take(gradients, self._free, axis=1), factor)
        self._table[:, self._free] = self._values
