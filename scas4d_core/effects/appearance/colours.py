"""The part that the colours of what moves and of what stands share: one table of RGB, with a rate for each Gaussian."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from scas4d_core.effects.parts import Array, Part, PartsBuilder, Work
from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians

if TYPE_CHECKING:
    from scas4d_core.update.rates import Adam, Rates


FASTER = 2.0
"""Times the rate of what stands, where the light changes: 0.1 to 0.2 dB on a lamp that crosses a room."""


MOST = 0.6
"""Share of moving Gaussians above which all have a place in the table: picking rows costs more than it saves."""


class Colours(Part):
    """RGB of the Gaussians as parameters of an update, with a term that keeps them as they were.

    Attributes:
        moving, standing: whether those of what moves and of what stands are free.
        lit: whether the light changes: then colours are freer, and what moves is as free as what stands.
    """

    moving = standing = lit = False
    known_to_devices = True

    def __init__(self, builder: PartsBuilder) -> None:
        self._rows, self._count = builder.hierarchy.rows, len(builder.first)
        self._whole = len(self._rows) > MOST * self._count
        self._optimizer: Adam

    def freed(self, rates: Rates) -> tuple[float, float]:
        """Adam's rates of the colours of what moves and of what stands."""
        moving, standing = rates.colour, rates.colour_standing
        if self.lit:
            standing = FASTER * standing
            moving = max(moving, standing)
        return moving if self.moving else 0.0, standing if self.standing else 0.0

    def start(self, work: Work) -> None:
        """Moments start at zero."""
        from scas4d_core.update import rates, schedule  # they load the kernels

        self._soft = np.float32(schedule.SOFT_COLOUR_WEIGHT / max(work.colours.size, 1))
        moving, standing = self.freed(work.rates)
        self._whole = self._whole or self.standing
        if self._whole:
            self._before = work.previous.colours
            self._table, by_row = work.colours, np.full(self._count, standing, np.float32)
            by_row[self._rows] = moving
        else:
            self._before = work.previous.colours[self._rows]
            self._table = work.colours[self._rows]
            by_row = np.full(len(self._rows), moving, np.float32)
        self._optimizer = rates.Adam(self._table, [1.0] * 3, work.rates, by_row=by_row)
        self.guards = self._optimizer.guards

    def loss(self, work: Work) -> float:
        """The mean absolute change."""
        self._change: Array = self._table - self._before
        return float(self._soft * np.abs(self._change).sum(dtype=np.float64)) if work.tells else 0.0

    def step(self, work: Work, iteration: int, planned: int) -> None:
        """Steps the colours."""
        pull: Array = self._soft * np.sign(self._change)
        found = work.gradients.features if self._whole else work.gradients.features[self._rows]
        self._optimizer.step(found[:, :3] + pull, iteration, planned)
        if not self._whole:
            work.colours[self._rows] = self._table

    def end(self, work: Work, state: Gaussians) -> Gaussians:
        """Θ_t has the colours of the end, where that is what is kept."""
        return state.replace(colours=work.colours) if work.kept is Candidate.END else state
