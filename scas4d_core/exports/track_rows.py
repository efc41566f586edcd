"""Choice of the Gaussians whose trajectories are exported."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scas4d_core.errors import InputError
from scas4d_core.gaussians import Gaussians

MAX_TRACKS = 500
"""Maximum number of trajectories, unless the Gaussians are given by their ids."""


def check_ids_found(ids: NDArray[np.int64], found: NDArray[np.bool_]) -> None:
    """Raises ``InputError`` if some of the requested ids [Q] were not found, according to the mask ``found`` [Q].

    An id is found if a state contains its Gaussian, even one that is absent from the frame.

    >>> check_ids_found(np.array([4, 5]), np.array([True, False]))
    Traceback (most recent call last):
    scas4d_core.errors.InputError: unknown Gaussian ids [5]; use ids of the exported states
    """
    if not found.all():
        raise InputError(f"unknown Gaussian ids {ids[~found][:5].tolist()}", "use ids of the exported states")


def evenly_spaced_moving_rows(first: Gaussians) -> NDArray[np.intp]:
    """Returns up to ``MAX_TRACKS`` rows of the Gaussians that move in the first frame, evenly spaced among them.

    >>> state = Gaussians.of_points(np.zeros((1000, 3)), radius=0.1)
    >>> rows = evenly_spaced_moving_rows(state)
    >>> len(rows), rows[[0, 1, -1]].tolist()
    (500, [0, 2, 999])
    """
    moving = np.flatnonzero(first.moving)
    return moving[np.linspace(0, len(moving) - 1, min(MAX_TRACKS, len(moving))).round().astype(np.intp)]
