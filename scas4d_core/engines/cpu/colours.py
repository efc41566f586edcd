"""Optimization of colours during an update, with per-Gaussian learning rates and the soft-colour loss."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.cpu.adam import Adam
from scas4d_core.engines.engine import AttemptStart

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
            self._before, self._table = before, colours
            by_row = np.full(count, start.static_colour if static else 0, np.float32)
            by_row[rows] = start.colour
        else:
            self._before, self._table = before[rows], colours[rows]
            by_row = np.full(len(rows), start.colour, np.float32)
        self._adam = Adam(self._table, [1.0] * 3, (start.beta1, start.beta2), by_row=by_row)
        self.guards = self._adam.guards
        self._change: Array

    def loss(self, curve: bool) -> float:
        """Returns the weighted soft-colour loss, or 0 if ``curve`` is false. Call before ``gradient`` and ``step``."""
        self._change = self._table - self._before
        return float(self._weight * np.abs(self._change).sum(dtype=np.float64)) if curve else 0.0

    def gradient(self, g_features: Array) -> Array:
        """Returns the gradient [table rows, 3] of the rendering losses and the soft-colour loss.

        Args:
            g_features: [N, 4] gradients of the rendering losses with respect to the features.
        """
        pull: Array = self._weight * np.sign(self._change)
        chosen = g_features if self._whole else g_features[self._rows]
        total: Array = chosen[:, :3] + pull
        return total

    def all_gradients(self, g_features: Array) -> Array:
        """Returns the last iteration's gradient [N, 3], which is 0 for Gaussians that are not in the table."""
        if self._whole:
            return self.gradient(g_features)
        total = np.zeros_like(self._colours)
        total[self._rows] = self.gradient(g_features)
        return total

    def step(self, g_features: Array, factor: float) -> None:
        """Performs one optimization step, with all learning rates scaled by ``factor``."""
        self._adam.step(self.gradient(g_features), factor)
        if not self._whole:
            self._colours[self._rows] = self._table
