"""Visibility of points, from the transmittance of the Gaussians in front of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Camera, WorldFrame
from scas4d_core.engines.limits import DEFAULT, Limits
from scas4d_core.gaussians import Gaussians, moving_extent
from scas4d_core.query.ray_depth import RAY_SOFTENING, REACH, RaySplats, tile_groups
from scas4d_core.storage.history import History

Float = NDArray[np.float64]

OWN_SURFACE = 0.015
"""Distance in front of a point within which Gaussians belong to its own surface, as a fraction of the extent. With
0.01, the fraction of correct answers rises by 0.01 for rigid objects, but falls by 0.03 for a cloth, whose Gaussians
are thicker than the cloth."""
MIN_TRANSMITTANCE = 0.3
"""Minimum transmittance of the Gaussians in front of a visible point."""


def find_visibility(
    history: History,
    world: WorldFrame,
    positions: Float,
    indices: Sequence[int] | NDArray[Any],
    camera: Camera,
    index: int,
    limits: Limits = DEFAULT,
) -> NDArray[np.bool_]:
    """Returns whether points are visible in a camera, [T, Q] bool: in its image, in front of it and not occluded.

    A point is occluded if the transmittance of the Gaussians in front of it is below ``MIN_TRANSMITTANCE``. Gaussians
    at most ``OWN_SURFACE`` in front of the point do not count.

    Args:
        history: history of committed states.
        world: transform from the user's world to the internal world.
        positions: [T, Q, 3] positions in the user's world. Points with NaN coordinates are not visible.
        indices: [T] committed frames.
        camera: camera in the user's world.
        index: frame whose moving Gaussians define the extent.
        limits: rasterizer constants.

    Raises:
        HistoryError: if a frame with points in the image was not committed.

    >>> from scas4d_core.gaussians import Gaussians
    >>> history = History()
    >>> history.append(0, 0.0, Gaussians.of_points([[0, 0, 2]], radius=0.1))
    >>> camera = Camera("front", [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4), 64, 48)
    >>> points = np.array([[[0, 0, 1.9], [0, 0, 3], [0.5, 0, 3]]])
    >>> find_visibility(history, WorldFrame(np.zeros(3)), points, [0], camera, index=0)
    array([[ True, False,  True]])
    """
    extent, visible = moving_extent(history.gaussians(index)), camera.in_image(camera.project(positions)[0])
    for t in np.flatnonzero(visible.any(axis=1)).tolist():  # states of other frames need not be read
        visible[t] = visible_points(history.gaussians(int(indices[t])), world, positions[t], camera, extent, limits)
    return visible


def visible_points(
    gaussians: Gaussians,
    world: WorldFrame,
    positions: Float,
    camera: Camera,
    extent: float,
    limits: Limits = DEFAULT,
) -> NDArray[np.bool_]:
    """Returns whether points are visible in one frame, [Q] bool; see ``find_visibility``.

    Args:
        gaussians: state in the internal world.
        world: transform from the user's world to the internal world.
        positions: [Q, 3] positions in the user's world.
        camera: camera in the user's world.
        extent: extent of the moving Gaussians, in metres.
        limits: rasterizer constants.

    >>> from scas4d_core.gaussians import Gaussians
    >>> camera = Camera("front", [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4), 64, 48)
    >>> state = Gaussians.of_points([[0, 0, 2]], radius=0.1)
    >>> points = np.array([[0, 0, 1.9], [0, 0, 3]])
    >>> visible_points(state, WorldFrame(np.zeros(3)), points, camera, extent=0.2)
    array([ True, False])
    """
    from scas4d_core.kernels.front_transmittance import front_transmittance  # deferred import: it loads the kernels

    uv, z = camera.project(positions)
    visible = camera.in_image(uv)
    rows = np.flatnonzero(visible)
    if not len(rows):
        return visible
    order, cuts = tile_groups(uv[rows])
    rows = rows[order]
    splats = RaySplats(gaussians, world.camera_to_inside(camera), uv[rows], limits, RAY_SOFTENING * extent)
    front = z[rows] * world.metres_per_unit - OWN_SURFACE * extent
    starts, transmittance = np.concatenate([[0], cuts, [len(rows)]]), np.empty(len(rows))
    shapes = splats.centre, splats.half, splats.conic, splats.peak, splats.means, splats.precision, splats.spread
    arrays = [np.ascontiguousarray(array) for array in (*shapes, np.concatenate(splats.lens), uv[rows], front)]
    constants = limits.alpha_cap, limits.alpha_floor, REACH, MIN_TRANSMITTANCE
    front_transmittance(*arrays, starts, *constants, transmittance)
    visible[rows] = transmittance >= MIN_TRANSMITTANCE
    return visible
