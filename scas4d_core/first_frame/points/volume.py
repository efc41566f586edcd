"""Unconfirmed points in the volume that cameras share, the last resort for initial points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scas4d_core.captures.frame import InitialPoints
from scas4d_core.posed_pictures import (
    Bool,
    Float,
    InitialPointsError,
    PosedPicture,
    look_at_point,
    observe,
    pixels_inside,
)

SAMPLES = 60_000
"""Number of sampled points, about one for every four pixels of the stereo images."""
KEPT = 0.25
"""Fraction of the points that are kept. The colours of these points differ least between
cameras."""
NEAR, FAR = 0.3, 1.7
"""Range of sampled depths, relative to the distance of the camera from the scene centre."""
FEW = 10
"""Minimum number of points for a reliable median depth."""


def shared_volume(views: Sequence[PosedPicture], distances: Sequence[float], seed: int) -> InitialPoints:
    """Samples points along pixel rays, and keeps points on whose colour the cameras agree best.

    The points need not lie on surfaces, because the fit of frame 0 moves, removes and adds
    Gaussians.

    Args:
        views: views of the cameras. A point is removed if any view sees the point outside its mask.
        distances: distance of each camera from the scene centre, in world units.
        seed: random seed of the samples.

    Raises:
        InitialPointsError: if no two cameras look at the same place, or the masks leave no place.

    >>> from scas4d_core.cameras import Camera
    >>> def seen(x):
    ...     pose = np.eye(4)
    ...     pose[:3, 3] = -x, 0, 2
    ...     lens = [[40, 0, 16], [0, 40, 16], [0, 0, 1]]
    ...     return PosedPicture(Camera(f"c{x}", lens, pose, 32, 32), np.full((32, 32, 3), 90, np.uint8))
    >>> cloud = shared_volume([seen(0.0), seen(0.3)], [2.0, 2.0], seed=0)
    >>> len(cloud) > 1000, cloud.colours[0].round(2)
    (True, array([0.35, 0.35, 0.35], dtype=float32))
    """
    rng = np.random.default_rng(seed)
    each = SAMPLES // len(views)
    drawn: list[Float] = []
    for view, distance in zip(views, distances, strict=True):
        uv = rng.random((each, 2)) * (view.camera.width, view.camera.height)
        depth = distance * (NEAR + (FAR - NEAR) * rng.random(each))
        drawn.append(view.camera.unproject(uv, depth))
    points = np.concatenate(drawn)
    inside, free = np.stack([_seen(view, points) for view in views], axis=1)
    if free.any(axis=0).all():
        raise InitialPointsError(
            "images: no place is in the foreground of all images that show it, according to the masks or, without "
            "masks, to the plain background; provide a point cloud or other masks"
        )
    points, inside = points[~free.any(axis=0)], inside[:, ~free.any(axis=0)]
    # Three cameras agree by chance less often than two.
    for needed in (3, 2):
        shared = inside.sum(axis=0) >= needed
        if shared.sum() >= KEPT * each:
            break
    else:
        raise InitialPointsError(
            "poses: no two cameras see the same place; if their images overlap, check that the poses belong to these "
            "cameras and have the direction that the format requires (world to camera; transforms.json: camera to "
            "world); otherwise provide a point cloud"
        )
    seen = observe(views, points[shared], inside[:, shared])
    best = np.argsort(seen.spread, kind="stable")[: int(KEPT * shared.sum())]
    # Points outside any mask were removed above. All other points are therefore foreground.
    masked = any(view.mask is not None for view in views)
    labels = np.ones(len(best), np.float32) if masked else None
    return InitialPoints(points[shared][best], seen.colours[best], labels)


def _seen(view: PosedPicture, points: Float) -> tuple[Bool, Bool]:
    """Returns whether each point is in the image, and whether it is also outside the mask, [P]."""
    column, line, _, inside = pixels_inside(view.camera, points)
    return inside, inside & ~view.mask[line, column] if view.mask is not None else np.zeros_like(inside)


def stage_distances(views: Sequence[PosedPicture], known: Float, radius: float) -> list[float]:
    """Returns the distance of each camera from the scene, measured along the viewing direction.

    The distance is the median depth of the known points in front of the camera. If there are too
    few points, the distance is the depth of the point where the optical axes meet.

    Args:
        views: views of the cameras.
        known: [P, 3] triangulated points. The array may be empty.
        radius: radius of the rig. It is used as the distance if the optical axes do not meet in
            front of the camera.
    """
    middle = look_at_point(views)
    distances = []
    for view in views:
        depth = view.camera.to_camera(known)[:, 2] if len(known) else np.zeros(0)
        depth = depth[depth > 0]
        ahead = float(view.camera.to_camera(middle[None])[0, 2])
        distances.append(float(np.median(depth)) if len(depth) >= FEW else ahead if ahead > radius / 10 else radius)
    return distances
