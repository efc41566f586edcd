"""Overlay of tracks on images, drawn as fading trails behind moving Gaussians."""

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
"""Supersampling factor of the drawn lines, for antialiasing."""
WIDTH = 1 / 200
"""Line width as a fraction of the image height."""
OPAQUE = 0.5
"""Minimum opacity of a Gaussian that counts as part of a surface rather than haze."""
CANDIDATES_PER_ROW = 0.5
"""Tracks are selected from this fraction of the moving Gaussians, those with the largest motion."""


def moving_rows(states: Sequence[Gaussians], count: int) -> NDArray[np.intp]:
    """Returns the rows of up to `count` Gaussians that move far, on trajectories that are far apart.

    The result is empty if no Gaussian moves.

    Args:
        states: states of a few frames, in order. Motion is measured relative to the first state, for Gaussians that are
            moving in all of these states.
        count: maximum number of rows.

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
    """Trails of the most recent positions of selected Gaussians, which can be drawn on any view.

    Args:
        rows: row indices of the Gaussians.
        world: transform between the user's world and the internal world.
        length: number of positions to keep per Gaussian, at least 2.

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
        """Appends the Gaussians' positions in the next state."""
        places = self._world.to_user(state.means[self._rows])
        places[~state.present[self._rows]] = np.nan
        self._places.append(places)

    def draw(self, picture: Picture, camera: Camera) -> Picture:
        """Returns the image [H, W, 3] with the trails drawn over it.

        Args:
            picture: rendered image.
            camera: camera with which the image was rendered, in the user's world.
        """
        height, width = picture.shape[:2]
        uv = np.stack([camera.project(places)[0] for places in self._places]) * SHARPER
        sheet = Image.new("RGBA", (width * SHARPER, height * SHARPER))
        draw = ImageDraw.Draw(sheet)
        thick = max(4, round(WIDTH * height * SHARPER))
        inside = (np.abs(uv) < 4 * SHARPER * max(width, height)).all(axis=2)  # false for NaN
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
