"""The free columns of a deformation's tables, and Adam's step over them.

A column that is not free is in no optimizer: it has no moments, takes no step and stays as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from scas4d_core.effects.freedom import Freedom
from scas4d_core.guards import GuardCounts
from scas4d_core.update.deformation import CpuDeformation
from scas4d_core.update.rates import Adam, Rates

Array = NDArray[np.float32]


def freed(rates: Rates, freedom: Freedom) -> Rates:
    """The rates with those of the deformation's parameters that are not free at 0.

    >>> rates = Rates(((0.1, 0.2, 0.3),), position=0.4, rotation=0.5, scale=0.6, colour=0.7)
    >>> freed(rates, Freedom(cluster_translation=True, own_scale=True))
    Rates(layers=((0.0, 0.2, 0.0),), position=0.0, rotation=0.0, scale=0.6, colour=0.7, ...)
    """
    free = (freedom.cluster_rotation, freedom.cluster_translation, freedom.cluster_scaling)
    return replace(
        rates,
        layers=tuple((r * free[0], t * free[1], scaling * free[2]) for r, t, scaling in rates.layers),
        position=rates.position * freedom.own_position,
        rotation=rates.rotation * freedom.own_rotation,
        scale=rates.scale * freedom.own_scale,
    )


class FreeTable:
    """The columns of one table of parameters whose rate is above 0, with their moments, which start at zero.

    Args:
        table, gradients: [n, columns]; the table is stepped in place, and by nobody else. columns: rate of each column.
        plan: of the rates. start, rest: shares of the iterations after which it begins, and rests.

    Attributes:
        guards: of its steps.
    """

    def __init__(
        self,
        table: Array,
        gradients: Array,
        columns: Sequence[float],
        plan: Rates,
        start: float = 0.0,
        rest: float = 1.0,
    ) -> None:
        self._table, self._gradients = table, gradients
        self._free = np.flatnonzero(columns)
        whole = len(self._free) == len(columns)
        # A copy in rows: the kernel is compiled for these.
        self._values = table if whole else np.take(table, self._free, axis=1)
        self._adam = Adam(self._values, [rate for rate in columns if rate], plan, start, rest)
        self.guards: GuardCounts = self._adam.guards

    def step(self, iteration: int, planned: int) -> None:
        """Take the step of an iteration, counted from 0."""
        if self._values is self._table:
            self._adam.step(self._gradients, iteration, planned)
            return
        self._adam.step(np.take(self._gradients, self._free, axis=1), iteration, planned)
        self._table[:, self._free] = self._values


def free_tables(deformation: CpuDeformation, rates: Rates) -> list[FreeTable]:
    """One per table that has a free column: each layer of clusters, the Gaussians' own deltas."""
    columns = [[r] * 3 + [t] * 3 + [scaling] * 4 for r, t, scaling in rates.layers]
    columns.append([rates.position] * 3 + [rates.rotation] * 3 + [rates.scale] * 3)
    times = [(rates.start_of(layer), rates.rest_of(layer)) for layer in range(len(rates.layers))] + [(rates.start, 1.0)]
    tables = [*deformation.clusters, deformation.deltas]
    gradients = [*deformation.cluster_gradients, deformation.delta_gradients]
    given = zip(tables, gradients, columns, times, strict=True)
    return [FreeTable(table, g, rate, rates, *time) for table, g, rate, time in given if any(rate)]
