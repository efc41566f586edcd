"""Relocates an object after a large jump: the update follows motions of less than the object's size, and none beyond.

Each camera compares its picture with the scene without its moving Gaussians: pixels that differ show the object. The
rays through the middle of the object now, and through the middle of its rendering before, meet in two points; their
difference is how far it went. Turns are left to the update that follows.
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
"""Of a colour channel, 0…1, from which a pixel shows the moving object and not the scene behind."""
SMALLEST_AREA = 0.25
"""Of the object's area in a picture that has to be seen now for the camera to have a say; at most its inverse."""
CAMERAS = 3
"""With a say that are needed."""
AGREE = 0.25
"""Of the distance found that the rays may miss each other by, root mean square: else they saw different things."""


def find_jump(gaussians: Gaussians, views: Sequence[TrainingView], renderer: Renderer, rig: Rig) -> Float | None:
    """[3] metres, how far the moving Gaussians have jumped; None where the cameras do not agree on it.

    Args:
        gaussians: Θ_{t−1}. views: of frame t. renderer: draws. rig: the cameras inside.
    """
    rows = gaussians.moving
    if not rows.any():
        return None
    still = gaussians.replace(opacities=np.where(rows, np.float32(0), gaussians.opacities))
    rays_before: list[tuple[Float, Float]] = []
    rays_now: list[tuple[Float, Float]] = []
    for view in views:
        before = renderer.render(gaussians, view.camera).features[LABEL] > 0.5
        behind = renderer.render(still, view.camera).features[:3]
        shown = view.exposure[:3, 0, None, None] * behind + view.exposure[:3, 1, None, None]
        now = np.abs(view.target[:3] - shown).max(axis=0) > DIFFERENT
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
    """The state with its moving Gaussians shifted by [3] metres."""
    means = gaussians.means.copy()
    means[gaussians.moving] += shift.astype(np.float32)
    return gaussians.replace(means=means)


def _ray(camera: Camera, pixels: NDArray[np.bool_]) -> tuple[Float, Float]:
    """Centre of a camera and [3] unit direction through the middle of marked pixels; centres lie at +0.5."""
    rows, columns = np.nonzero(pixels)
    middle = np.array([columns.mean() + 0.5, rows.mean() + 0.5, 1.0])
    direction = camera.world_to_camera[:3, :3].T @ np.linalg.solve(camera.intrinsics, middle)
    return camera.centre, direction / np.linalg.norm(direction)


def _meeting(rays: Sequence[tuple[Float, Float]]) -> tuple[Float, float]:
    """[3] the point nearest to all rays, and its root mean square distance from them."""
    across = [np.eye(3) - np.outer(direction, direction) for _, direction in rays]
    left = np.sum(across, axis=0)
    right = np.sum([matrix @ origin for matrix, (origin, _) in zip(across, rays, strict=True)], axis=0)
    point: Float = np.linalg.lstsq(left, right, rcond=None)[0]
    off = [np.linalg.norm(matrix @ (point - origin)) for matrix, (origin, _) in zip(across, rays, strict=True)]
    return point, float(np.sqrt(np.mean(np.square(off))))
