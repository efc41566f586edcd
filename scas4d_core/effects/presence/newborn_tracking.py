"""Tracking of objects added in the previous frame, whose motion is unknown and may exceed their width.

Each object is removed from the state, and its hull is carved again from the images of the frame. The displacement
between the two hulls initializes the translation of its clusters.
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
"""Maximum ratio between the volumes of two hulls of the same object, which may enter gradually."""
OWN = 0.5
"""Minimum share of a cluster's Gaussians that must belong to an object for the cluster to start with the object's
displacement."""


class NewbornTracking(UpdatePart):
    """Sets the initial translation of the coarsest clusters of objects added in the previous frame.

    Args:
        builder: builder of the update plan.
        name: name of the effect whose arrays describe the added objects. The arrays contain the row ("newborn") and the
            object number ("thing") of each added Gaussian. For each of the T objects, they contain the centre of its
            hull ("centres", [T, 3], metres), its volume ("volumes", [T], cubic metres), and the mean position of its
            Gaussians ("places", [T, 3], metres).
    """

    def __init__(self, builder: PlanBuilder, name: str) -> None:
        self._hierarchy, self._factory, self._name = builder.hierarchy, builder.factory, name

    def begin(self, attempt: Attempt) -> None:
        """Starts the clusters of objects added in the previous frame with the displacements found in the images."""
        arrays = attempt.carried.get(self._name)
        if arrays is None or not len(arrays["newborn"]) or not attempt.tables.clusters:
            return
        rest = attempt.previous.retire(arrays["newborn"])
        hull = carve_new(measure_novelty(rest, rest.colours, attempt.views, self._factory.posed, attempt.renderer))
        attempt.tables = attempt.tables.copy()  # an engine may keep the tables that it has loaded
        thing = np.full(len(attempt.previous), -1)
        thing[arrays["newborn"]] = arrays["thing"]
        of_entries, labels = thing[self._hierarchy.rows], self._hierarchy.labels[0]
        counts = np.bincount(labels)
        for number, way in _displacements(hull, arrays).items():
            way = way - _displacement(attempt.previous, arrays, number)
            own = np.bincount(labels, weights=of_entries == number, minlength=len(counts)) > OWN * counts
            attempt.tables.clusters[0][own, 3:6] = way


def _displacement(state: Gaussians, arrays: Arrays, number: int) -> Float:
    """Returns an object's [3] displacement since it was added, in metres.

    The displacement is non-zero if an attempt starts from the end of another attempt.
    """
    rows = arrays["newborn"][arrays["thing"] == number]
    if not len(rows):
        return np.zeros(3)
    gone: Float = state.means[rows].mean(axis=0) - arrays["places"][number]
    return gone


def _displacements(hull: Hull, arrays: Arrays) -> dict[int, Float]:
    """Returns the [3] displacement of each object to the nearest hull of similar volume, in metres, if there is one."""
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
