"""Adam over the parameters of an update: one table of them, or the free columns of one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scas4d_core.guards import GuardCounts
from scas4d_core.kernels.adam import COUNTED_GUARDS, EVERY_ROW, adam

Array = NDArray[np.float32]


class Adam:
    """Adam over one table of parameters, with a rate for each column, times one for each row where given.

    Args:
        parameters: [n, columns] float32; stepped in place. columns: rate of each column.
        betas: decays of the two moments, which start at zero. by_row: [n] factor on the rates of each row.

    Attributes:
        guards: how often each guard of a step acted.
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
        """Take a step.

        Args:
            gradients: [n, columns]. factor: on all rates; 0 takes no step and leaves the moments.
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
    """Adam over the columns of a table whose rate is above 0; the others have no moments and stay as they are.

    Args:
        table: [n, columns]; the table is stepped in place, and by nobody else. columns: rate of each column, one of
            them above 0. betas: see ``Adam``.
    """

    def __init__(self, table: Array, columns: Sequence[float], betas: tuple[float, float]) -> None:
        self._table = table
        self._free = np.flatnonzero(columns)
        # The kernel is compiled for contiguous rows, so some columns are stepped in a copy.
        self._values = table if len(self._free) == len(columns) else np.take(table, self._free, axis=1)
        self._adam = Adam(self._values, [rate for rate in columns if rate], betas)
        self.guards: GuardCounts = self._adam.guards

    def step(self, gradients: Array, factor: float) -> None:
        """Take a step; see ``Adam.step``."""
        if self._values is self._table:
            self._adam.step(gradients, factor)
            return
        self._adam.step(np.take(gradients, self._free, axis=1), factor)
        self._table[:, self._free] = self._values
