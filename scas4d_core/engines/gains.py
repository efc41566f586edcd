"""Gains of the cameras, followed while an update runs: each round over the cameras measures each gain once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.exposure import gain_to_exposure, measured_gain, update_gains
from scas4d_core.engines.views import TrainingView

Array = NDArray[np.float32]


class GainEstimator:
    """The gains of an attempt; the views have them as their exposure.

    Args:
        gains: [cameras, 3] at the start. rows: row of each camera, by name. views: whose exposures are set in place.
    """

    def __init__(self, gains: Array, rows: Mapping[str, int], views: Sequence[TrainingView]) -> None:
        self.gains = gains.copy()
        self._rows, self._views = rows, list(views)
        self._measured: dict[int, Array] = {}
        self._expose()

    def leave_out(self, views: Sequence[TrainingView]) -> None:
        """These views take no part any more; their exposures stay."""
        self._views = [view for view in self._views if view not in views]

    def record_rendering(self, view: TrainingView, shown: Array) -> None:
        """Measure a camera's gain in its rendering; a camera's second rendering begins a new round.

        Args:
            shown: [3, H, W] rendering without exposure.
        """
        row = self._rows[view.name]
        if row in self._measured:
            self.finish_round()
        self._measured[row] = measured_gain(view.target, shown)

    def finish_round(self) -> None:
        """End a round: gains and exposures follow what it measured."""
        settled = update_gains(self.gains, self._measured, len(self._views))
        if settled is not None:
            self.gains = settled
            self._expose()
        self._measured = {}

    def _expose(self) -> None:
        for view in self._views:
            view.exposure[:3] = gain_to_exposure(self.gains[self._rows[view.name]])
