"""Tracks drawn over pictures: trails behind Gaussians that move, which fade."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from client.wire import part_colour
from scas4d_core.cameras import Camera, WorldFrame, farthest_first
from scas4d_core.gaussians import Gaussians

Picture = NDArray[np.uint8]

SHARPER = 2
"""Lines are drawn so many times larger and then reduced: their edges are smooth."""
WIDTH = 1 / 200
"""Of the picture's height."""
OPAQUE = 0.5
"""Opacity from which a Gaussian is of a surface and not of haze."""
CANDIDATES_PER_ROW = 0.5
"""Share of the Gaussians, those that move most, of which some are taken."""


def moving_rows(states: Sequence[Gaussians], count: int) -> NDArray[np.intp]:
    """[count] rows, or fewer: of the Gaussians that move most, some whose ways are far apart; none where none moves.

    Args:
        states: of some frames, the first the earliest; motion is measured from it. Only what moves in all is taken.

    >>> a = Gaussians.of_points([[0, 0, 2], [1, 0, 2], [2, 0, 2]], radius=0.1)
    >>> b = a.replace(means=a.means + np.float32([[0, 0, 0], [0, 1, 0], [0, 2, 0]]))
    >>> moving_rows([a, b], 1)
    array([2])
    """
    first = states[0]
    there = first.moving.copy()
    moved = np.zeros(len(first))
    for state in states[1:]:
        there &= state.moving[: len(first)]
        moved = np.maximum(moved, np.linalg.norm(state.means[: len(first)] - first.means, axis=1))
    solid = there & (first.opacities >= OPAQUE)
    rows = np.flatnonzero(solid if solid.any() else there)
    if not rows.size or not count:
        return np.zeros(0, np.intp)
    rows = rows[np.argsort(-moved[rows], kind="stable")]
    rows = rows[: max(count, round(CANDIDATES_PER_ROW * rows.size))]
    ways = np.concatenate([state.means[rows] for state in states], axis=1)
    chosen: NDArray[np.intp] = rows[farthest_first(ways, count)]
    return chosen


class Trails:
    """The last places of some Gaussians, in the world; drawn from any camera.

    Args:
        rows: of the Gaussians. world: user's world to inside. length: places that are kept of each, at least 2.

    >>> state = Gaussians.of_points([[0, 0, 2]], radius=0.1)
    >>> trails = Trails(np.array([0]), WorldFrame(np.zeros(3)), length=9)
    >>> trails.add(state)
    >>> camera = Camera("a", [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4), 64, 48)
    >>> drawn = trails.draw(np.zeros((48, 64, 3), np.uint8), camera)
    >>> bool(drawn[24, 32].any()), bool(drawn[4, 4].any())
    (True, False)
    """

    def __init__(self, rows: NDArray[np.intp], world: WorldFrame, length: int) -> None:
        self._rows, self._world = rows, world
        self._places: deque[NDArray[np.float64]] = deque(maxlen=max(length, 2))
        self._colours = [part_colour(number) for number in range(len(rows))]

    def add(self, state: Gaussians) -> None:
        """Adds the places of a state, the newest."""
        places = self._world.to_user(state.means[self._rows])
        places[~state.present[self._rows]] = np.nan
        self._places.append(places)

    def draw(self, picture: Picture, camera: Camera) -> Picture:
        """The picture [H, W, 3] with the trails over it; camera: of the picture, user's world."""
        height, width = picture.shape[:2]
        uv = np.stack([camera.project(places)[0] for places in self._places]) * SHARPER
        sheet = Image.new("RGBA", (width * SHARPER, height * SHARPER))
        draw = ImageDraw.Draw(sheet)
        thick = max(4, round(WIDTH * height * SHARPER))
        inside = (np.abs(uv) < 4 * SHARPER * max(width, height)).all(axis=2)  # NaN is not; nor what is far outside
        for step in range(1, len(uv)):
            alpha = round(255 * step / (len(uv) - 1))
            for track in np.flatnonzero(inside[step - 1] & inside[step]):
                ends = [tuple(uv[step - 1, track]), tuple(uv[step, track])]
                draw.line(ends, fill=(*self._colours[track], alpha), width=thick)
        for track in np.flatnonzero(inside[-1]):
            u, v = uv[-1, track]
            draw.ellipse((u - thick, v - thick, u + thick, v + thick), fill=(*self._colours[track], 255))
        small = sheet.reduce(SHARPER)
        image = Image.fromarray(picture)
        image.paste(small, (0, 0), small)
        return np.asarray(image)
