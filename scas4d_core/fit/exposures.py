"""Gain and offset of each camera, learnt while frame 0 is fitted, and given up where the cameras are alike."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.views import TrainingView
from scas4d_core.kernels.adam import EVERY_ROW, adam

Array = NDArray[np.float32]

TRIAL, SPREAD = 0.3, 0.015
"""Share of the iterations after which exposure terms are assessed, and the standard deviation of the gains over cameras
below which they are given up. After 900 iterations it was 0.004 and 0.007 on equal cameras, 0.033 on a real rig."""


class Exposures:
    """Learns the exposures of the views of frame 0, in place.

    Args:
        views: of the frame. rate: Adam's, of gain and offset. beta1, beta2: its decays.

    Attributes:
        on: whether they are learnt still.
    """

    def __init__(self, views: Sequence[TrainingView], on: bool, rate: float, beta1: np.float32, beta2: np.float32):
        self.on = on
        self._views, self._rate, self._betas = views, rate, (beta1, beta2)
        self._moments = {view.name: np.zeros((2, *view.exposure.shape), np.float32) for view in views}

    def step(self, view: TrainingView, gradient: Array, steps: int) -> None:
        """Adam on a camera's gain and offset; afterwards their mean over cameras is brought back to 1 and 0.

        Args:
            gradient: [C, 2] of the loss; the label's does not count. steps: taken, this one too.
        """
        if not self.on:
            return
        moments = self._moments[view.name]
        rates = np.full(2, self._rate, np.float32)
        gradient = gradient[: len(view.exposure)].copy()
        gradient[3:] = 0
        adam(view.exposure, gradient, moments[0], moments[1], rates, EVERY_ROW, *self._betas, steps)
        centre = np.mean([other.exposure[:3] for other in self._views], axis=0) - np.array([1, 0], np.float32)
        for other in self._views:
            other.exposure[:3] -= centre

    def assess(self) -> None:
        """Gives up gains and offsets that hardly differ from camera to camera."""
        gains = np.array([view.exposure[:3, 0] for view in self._views])
        if gains.std(axis=0).mean() < SPREAD:
            self.on = False
            for view in self._views:
                view.exposure[:] = (1, 0)

    def by_camera(self) -> dict[str, Array]:
        """[3, 2] of each camera; none where they are not learnt."""
        return {view.name: view.exposure[:3].copy() for view in self._views} if self.on else {}
