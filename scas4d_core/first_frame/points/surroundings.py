"""Surroundings of the scene, represented by coloured points far behind the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scas4d_core.captures.frame import InitialPoints
from scas4d_core.posed_pictures import Bool, Float, PosedPicture, look_at_point

ACROSS = 40
"""Number of points along the longer side of an image. The fit refines the points."""
BEHIND = 2.0
"""Distance of the points behind the scene centre, relative to the largest distance of a camera from the centre."""
STAGE = 1.5
"""Radius of the stage, relative to the largest distance of a camera from the scene centre. The stage contains all
cameras and the shared volume."""


@dataclass(frozen=True, eq=False)
class Stage:
    """Ball that contains the cameras and the shared volume.

    Attributes:
        middle: [3] centre in the world.
        radius: radius, in world units.
    """

    middle: Float
    radius: float

    @classmethod
    def of(cls, views: Sequence[PosedPicture], distances: Sequence[float]) -> Stage:
        """Returns the stage for cameras at the given distances from the scene centre, in world units."""
        return cls(look_at_point(views), STAGE * max(distances))

    def holds(self, points: NDArray[np.floating]) -> Bool:
        """Returns whether each of the points [P, 3] is inside the stage, [P].

        >>> Stage(np.zeros(3), 2.0).holds(np.array([[1.0, 0, 0], [3.0, 0, 0]]))
        array([ True, False])
        """
        held: Bool = np.linalg.norm(points - self.middle, axis=1) < self.radius
        return held


def surroundings(views: Sequence[PosedPicture], distances: Sequence[float]) -> InitialPoints:
    """Returns points far behind the scene, along rays through the pixels of each camera.

    If the cameras are few and far apart, each camera sees walls and other surfaces that no other
    camera sees. The depth of these surfaces is unknown. Points at a small depth would hide the
    scene from the other cameras. Points far behind the scene are rarely visible to the other
    cameras, and then look like a backdrop.

    Args:
        views: views of the cameras. Pixels inside the mask show the scene and get no point.
        distances: distance of each camera from the scene centre, in world units.

    Returns:
        Points with the colours of their pixels, labelled as background if there are masks.

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
