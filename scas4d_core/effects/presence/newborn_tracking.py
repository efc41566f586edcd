"""Catches what was born in the frame before: its motion is not known yet, and it may fall further than its width.

Its hull is carved out of the pictures of the frame once more, without it; the way from the one hull to the other is
where its clusters start from.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scas4d_core.effects.presence.carving import Hull, carve_new
from scas4d_core.effects.presence.novelty import measure_novelty
from scas4d_core.update.parts import Attempt, PlanBuilder, UpdatePart

if TYPE_CHECKING:
    from scas4d_core.gaussians import Gaussians
    from scas4d_core.update.parts import Arrays

Float = NDArray[np.float64]

SAME = 2.5
"""Times larger or smaller that a hull may be and still be that of the same thing: it comes gradually into view."""
OWN = 0.5
"""Share of a cluster's Gaussians that must belong to the thing for the cluster to start with its way."""


class NewbornTracking(UpdatePart):
    """Sets the shift of the coarsest clusters of what was born in the frame before.

    Args:
        name: of the effect, whose arrays name the rows ("newborn"), the thing of each ("thing"), and for each thing its
            hull's centre ("centres", [T, 3] metres) and volume ("volumes", cubic metres), and the mean of its Gaussians
            ("places", [T, 3] metres).
    """

    def __init__(self, builder: PlanBuilder, name: str) -> None:
        self._hierarchy, self._factory, self._name = builder.hierarchy, builder.factory, name

    def begin(self, attempt: Attempt) -> None:
        """Locates each thing that was born in the frame before in the pictures of this frame."""
        arrays = attempt.carried.get(self._name)
        if arrays is None or not len(arrays["newborn"]) or not attempt.tables.clusters:
            return
        rest = attempt.previous.retire(arrays["newborn"])
        hull = carve_new(measure_novelty(rest, rest.colours, attempt.views, self._factory.posed, attempt.renderer))
        thing = np.full(len(attempt.previous), -1)
        thing[arrays["newborn"]] = arrays["thing"]
        of_entries, labels = thing[self._hierarchy.rows], self._hierarchy.labels[0]
        counts = np.bincount(labels)
        for number, way in _displacements(hull, arrays).items():
            way = way - _displacement(attempt.previous, arrays, number)
            own = np.bincount(labels, weights=of_entries == number, minlength=len(counts)) > OWN * counts
            attempt.tables.clusters[0][own, 3:6] = way


def _displacement(state: Gaussians, arrays: Arrays, number: int) -> Float:
    """[3] metres that a newborn thing has gone since its frame: an attempt may start from where another ended."""
    rows = arrays["newborn"][arrays["thing"] == number]
    if not len(rows):
        return np.zeros(3)
    gone: Float = state.means[rows].mean(axis=0) - arrays["places"][number]
    return gone


def _displacements(hull: Hull, arrays: Arrays) -> dict[int, Float]:
    """By number of a newborn thing, [3] metres to the nearest hull of about its size."""
    displacements: dict[int, Float] = {}
    numbers = np.unique(hull.things)
    centres = np.array([hull.points[hull.things == number].mean(axis=0) for number in numbers]).reshape(-1, 3)
    volumes = np.array([(hull.things == number).sum() * hull.voxel**3 for number in numbers])
    for thing, (centre, volume) in enumerate(zip(arrays["centres"], arrays["volumes"], strict=True)):
        alike = (volumes < SAME * volume) & (volumes > volume / SAME)
        if alike.any():
            ways = (centres - centre)[alike]
            displacements[thing] = ways[np.argmin(np.square(ways).sum(axis=1))]
    return displacements
