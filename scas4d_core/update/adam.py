"""Adam with a rate per column, a schedule and a late start; the step itself is ``kernels.adam``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scas4d_core.guards import GuardCounts
from scas4d_core.kernels.adam import ACTED, EVERY_ROW, adam
from scas4d_core.update.schedule import Rates

Array = NDArray[np.float32]


class Adam:
    """Adam over one table of parameters, with a rate per column, times one per row where given.

    It begins after a share ``start`` of the iterations and leaves the table alone before. ``guards`` counts how often
    each guard of the step acted.
    """

    def __init__(
        self, parameters: Array, columns: list[float], rates: Rates, start: float = 0.0, by_row: Array = EVERY_ROW
    ) -> None:
        self._parameters = parameters
        self._by_row = by_row
        self._first, self._second = np.zeros_like(parameters), np.zeros_like(parameters)
        self._plan, self._start = rates, start
        self._rates = np.array(columns, np.float32)
        self._beta1, self._beta2 = np.float32(rates.beta1), np.float32(rates.beta2)
        self._steps = 0
        self.guards = GuardCounts(*ACTED)

    def step(self, gradients: Array, iteration: int, iterations: int) -> None:
        """Take the step of an iteration, counted from 0."""
        factor = self._plan.factor(iteration, iterations, self._start)
        if factor == 0:
            return
        self._steps += 1
        acted = adam(
            self._parameters, gradients, self._first, self._second, self._rates * np.float32(factor), self._by_row,
            self._beta1, self._beta2, self._steps,
        )  # fmt: skip
        self.guards.add(ACTED, acted)
