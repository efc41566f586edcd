"""Relocation of an object that has jumped farther than about its own size, which an update alone cannot track.

Each image is compared with a rendering of the scene without moving Gaussians; pixels that differ show the object. The
rays of all cameras through the object's centre are intersected, once for the images and once for renderings of the
previous state. The difference between the two points is the displacement. The update that follows finds the rotation.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Camera, Rig
from scas4d_core.engines.renderer import Renderer
from scas4d_core.engines.views import LABEL, TrainingView
from scas4d_core.gaussians import Gaussians

Float = NDArray[np.float64]

DIFFERENT = 0.1
"""Channel difference, [0, 1], above which a pixel shows the moving object and not the background."""
SMALLEST_AREA = 0.25
"""Minimum ratio of the object's area in an image to its rendered area; the maximum is the inverse."""
CAMERAS = 3
"""Minimum number of cameras with a plausible object area."""
AGREE = 0.25
"""Maximum RMS distance of the rays from their intersection, relative to the displacement, at which cameras agree."""


def find_jump(gaussians: Gaussians, views: Sequence[TrainingView], renderer: Renderer, rig: Rig) -> Float | None:
    """Returns the [3] displacement of the moving Gaussians in metres, or None if the cameras do not agree.

    Args:
        gaussians: previous state Θ_{t−1}.
        views: views of frame t.
        renderer: renderer for the state.
        rig: cameras in the internal world.
    """
    rows = gaussians.moving
    if not rows.any():
        return None
    still = gaussians.replace(opacities=np.where(rows, np.float32(0), gaussians.opacities))
    rays_before: list[tuple[Float, Float]] = []
    rays_now: list[tuple[Float, Float]] = []
    pictures = renderer.render_each([(state, view.camera) for view in views for state in (gaussians, still)])
    for view in views:
        before = next(pictures).features[LABEL] > 0.5
        behind = next(pictures).features[:3]
        now = np.abs(view.target[:3] - view.exposed(behind)).max(axis=0) > DIFFERENT
        if not before.any() or not SMALLEST_AREA <= now.sum() / before.sum() <= 1 / SMALLEST_AREA:
            continue
        camera = rig[view.name]
        rays_before.append(_ray(camera, before))
        rays_now.append(_ray(camera, now))
    if len(rays_now) < CAMERAS:
        return None
    start, _ = _meeting(rays_before)
    end, miss = _meeting(rays_now)
    shift = end - start
    if miss > AGREE * float(np.linalg.norm(shift)):
        return None
    return shift


def shift_moving(gaussians: Gaussians, shift: Float) -> Gaussians:
    """Returns the state with its moving Gaussians shifted by a vector [3], in metres."""
    means = gaussians.means.copy()
    means[gaussians.moving] += shift.astype(np.float32)
    return gaussians.replace(means=means)


def _ray(camera: Camera, pixels: NDArray[np.bool_]) -> tuple[Float, Float]:
    """Returns a camera's centre and the [3] unit direction through the centroid of the marked pixels."""
    rows, columns = np.nonzero(pixels)
    middle = np.array([columns.mean() + 0.5, rows.mean() + 0.5, 1.0])
    direction = camera.world_to_camera[:3, :3].T @ np.linalg.solve(camera.intrinsics, middle)
    return camera.centre, direction / np.linalg.norm(direction)


def _meeting(rays: Sequence[tuple[Float, Float]]) -> tuple[Float, float]:
    """Returns the [3] point with the smallest RMS distance to all rays, and that distance."""
    across = [np.eye(3) - np.outer(direction, direction) for _, direction in rays]
    left = np.sum(across, axis=0)
    right = np.sum([matrix @ origin for matrix, (origin, _) in zip(across, rays, strict=True)], axis=0)
    point: Float = np.linalg.lstsq(left, right, rcond=None)[0]
    off = [np.linalg.norm(matrix @ (point - origin)) for matrix, (origin, _) in zip(across, rays, strict=True)]
    return point, float(np.sqrt(np.mean(np.square(off))))
