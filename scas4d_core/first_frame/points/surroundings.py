"""Surroundings: what each camera sees beyond the stage, painted far behind it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scas4d_core.captures.frame import InitialPoints
from scas4d_core.posed_pictures import Bool, Float, PosedPicture, look_at_point

ACROSS = 40
"""Points along the longer side of a picture; the fit refines them."""
BEHIND = 2.0
"""Distance at which they lie behind the middle of the stage, times the largest distance of a camera to the middle."""
STAGE = 1.5
"""Radius of the stage, times the same distance: all cameras and what they share lie within, surroundings beyond."""


@dataclass(frozen=True, eq=False)
class Stage:
    """The ball that holds the cameras and what they share.

    Attributes:
        middle: [3] world. radius: world units.
    """

    middle: Float
    radius: float

    @classmethod
    def of(cls, views: Sequence[PosedPicture], distances: Sequence[float]) -> Stage:
        """Of cameras with these distances to what they look at, world units."""
        return cls(look_at_point(views), STAGE * max(distances))

    def holds(self, points: NDArray[np.floating]) -> Bool:
        """[P] which points [P, 3] are on the stage.

        >>> Stage(np.zeros(3), 2.0).holds(np.array([[1.0, 0, 0], [3.0, 0, 0]]))
        array([ True, False])
        """
        held: Bool = np.linalg.norm(points - self.middle, axis=1) < self.radius
        return held


def surroundings(views: Sequence[PosedPicture], distances: Sequence[float]) -> InitialPoints:
    """Points far behind the stage, on the rays of each camera's own pixels.

    Where a few cameras stand far apart, most of what one sees no other does: walls, and the room behind. Its depth
    is not known. Near by it would hide the stage from the other cameras; so far off hardly another camera has it in
    its picture, and one that has sees it as a backdrop.

    Args:
        views: with pictures; pixels in a mask show the stage, and get no point.
        distances: of each camera to the middle of the stage, world units.

    Returns:
        Points with their pixel's colour; with masks they are labelled as background.

    >>> from scas4d_core.cameras import Camera
    >>> camera = Camera("a", np.array([[40.0, 0, 20], [0, 40, 20], [0, 0, 1]]), np.eye(4), 40, 40)
    >>> found = surroundings([PosedPicture(camera, np.full((40, 40, 3), 255, np.uint8))], [2.0])
    >>> len(found), float(found.positions[:, 2].min()), float(found.colours.min())
    (1600, 6.0, 1.0)
    """
    farthest = max(distances)
    points, colours = [], []
    for view, distance in zip(views, distances, strict=True):
        camera = view.camera
        step = max(camera.width, camera.height) / ACROSS
        across, down = np.arange(step / 2, camera.width, step), np.arange(step / 2, camera.height, step)
        uv = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
        column, line = uv.astype(np.intp).T
        if view.mask is not None:
            off = ~view.mask[line, column]
            uv, column, line = uv[off], column[off], line[off]
        points.append(camera.unproject(uv, np.full(len(uv), distance + BEHIND * farthest)))
        colours.append(view.image[line, column] / np.float32(255))
    masked = any(view.mask is not None for view in views)
    positions = np.concatenate(points)
    return InitialPoints(positions, np.concatenate(colours), np.zeros(len(positions), np.float32) if masked else None)
