"""Estimation of camera gains during an update, in rounds that measure each camera at most once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.exposure import gain_to_exposure, measured_gain, update_gains
from scas4d_core.engines.views import TrainingView

Array = NDArray[np.float32]


class GainEstimator:
    """Estimates the camera gains during one attempt and applies them to the exposures of the views.

    Args:
        gains: [cameras, 3] initial gains.
        rows: maps each camera name to its row in ``gains``.
        views: training views, whose exposures are updated in place.

    Attributes:
        gains: [cameras, 3] current gains.
    """

    def __init__(self, gains: Array, rows: Mapping[str, int], views: Sequence[TrainingView]) -> None:
        self.gains = gains.copy()
        self._rows, self._views = rows, list(views)
        self._measured: dict[int, Array] = {}
        self._expose()

    def leave_out(self, views: Sequence[TrainingView]) -> None:
        """Excludes views from further rounds and leaves their exposures unchanged."""
        self._views = [view for view in self._views if view not in views]

    def record_rendering(self, view: TrainingView, shown: Array) -> None:
        """Measures a camera's gain from a rendering. A second measurement of the same camera starts a new round.

        Args:
            view: training view that was rendered.
            shown: [3, H, W] rendering, before the camera's exposure is applied.
        """
        row = self._rows[view.name]
        if row in self._measured:
            self.finish_round()
        self._measured[row] = measured_gain(view.target, shown)

    def finish_round(self) -> None:
        """Ends the current round, and updates the gains and exposures if the round has enough measurements."""
        settled = update_gains(self.gains, self._measured, len(self._views))
        if settled is not None:
            self.gains = settled
            self._expose()
        self._measured = {}

    def _expose(self) -> None:
        for view in self._views:
            view.exposure[:3] = gain_to_exposure(self.gains[self._rows[view.name]])
