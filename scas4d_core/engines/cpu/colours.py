"""Optimization of colours during an update, with per-Gaussian learning rates and the soft-colour loss."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.cpu.adam import Adam
from scas4d_core.engines.engine import AttemptStart
from scas4d_core.kernels.soft_colour import soft_colour

Array = NDArray[np.float32]

MOST = 0.6
"""Fraction of moving Gaussians above which the table contains all Gaussians, because indexing a subset would cost
more."""


class Colours:
    """Colours learned during an attempt, with their optimizer.

    Args:
        colours: [N, 3] RGB colours, updated in place.
        before: [N, 3] colours of Θ_{t−1}.
        rows: [M] rows of the moving Gaussians.
        static: whether the colours of static Gaussians are also learned.
        weight: weight of the soft-colour loss, the mean absolute change (Dynamic3DGaussians).
        start: settings of the attempt, with learning rates and Adam decay rates.
    """

    def __init__(
        self,
        colours: Array,
        before: Array,
        rows: NDArray[np.int64],
        static: bool,
        weight: float,
        start: AttemptStart,
    ) -> None:
        count = len(colours)
        self._colours, self._rows = colours, rows
        self._weight = np.float32(weight / max(colours.size, 1))
        self._whole = static or len(rows) > MOST * count
        if self._whole:
            self._before, self._table, self._table_rows = before, colours, rows[:0]
            by_row = np.full(count, start.static_colour if static else 0, np.float32)
            by_row[rows] = start.colour
        else:
            self._before, self._table, self._table_rows = before[rows], colours[rows], rows
            by_row = np.full(len(rows), start.colour, np.float32)
        self._adam = Adam(self._table, [1.0] * 3, (start.beta1, start.beta2), by_row=by_row)
        self.guards = self._adam.guards
        self._gradients = np.zeros_like(self._table)

    def loss(self, g_features: Array) -> float:
        """Returns the weighted soft-colour loss, and computes the gradients for ``step``.

        Args:
            g_features: [N, 4] gradients of the rendering losses with respect to the features.
        """
        change = soft_colour(self._table, self._before, self._table_rows, g_features, self._weight, self._gradients)
        return float(self._weight * change)

    def gradients(self) -> Array:
        """Returns the last iteration's gradients [N, 3], which are 0 for Gaussians that are not in the table."""
        if self._whole:
            return self._gradients.copy()
        total = np.zeros_like(self._colours)
        total[self._rows] = self._gradients
        return total

    def step(self, factor: float) -> None:
        """Performs one optimization step, with all learning rates scaled by ``factor``."""
        self._adam.step(self._gradients, factor)
        if not self._whole:
            self._colours[self._rows] = self._table
