"""The labels of moving Gaussians: by the masks of frame 0; without masks learnt from the pictures of two frames.

A static Gaussian inside the silhouettes of nearly all cameras lies within a moving object, and moves with it. The label
of an object is only learnt at its outside; a Gaussian that stays behind inside is a ghost once the object has gone.

Without masks, a pixel has changed where it differs from the frame before. A Gaussian moves when most of the cameras
that see it have it in changed pixels: the background behind the new place of an object has changed for some cameras,
but not for most.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from scas4d_core.cameras import Rig
from scas4d_core.engines.renderer import Renderer
from scas4d_core.engines.views import TrainingView
from scas4d_core.gaussians import Gaussians
from scas4d_core.posed_pictures import pixels_inside

Array = NDArray[np.float32]

CHANGE = 0.04
"""Difference of a colour channel, 0…1, from which a pixel has changed: above the noise of a sensor and of JPEG."""
REACH_PIXELS = 5
"""Side of the square that a changed pixel marks: the inside of a plain surface moves without changing."""
SEEN_PIXELS = 0.02
"""Pixels' worth of blending weight from which a camera has a vote."""
IN_CHANGE = 0.5
"""Share of a Gaussian's weight in changed pixels from which a camera votes that it moves."""
MAJORITY = 0.5
"""Share of the voting cameras that have to agree that a Gaussian moves; and at least two."""

STANDING_SHARE = 0.1
"""Share of standing Gaussians from which a scene has a standing part; below, their labels are noise."""

INSIDE_SHARE = 0.8
"""Share of the cameras with a mask and a Gaussian in their picture whose masks have to hold its mean, for it to lie
within a moving object. Automatic masks are ragged: with 0.7 to 0.9 the ghosts of `basketball` fade alike."""
INSIDE_CAMERAS = 3
"""Such cameras there have to be at least: the silhouettes of two hold much that is empty."""

FIRST_LABELS = 32
"""Gaussians that must be found moving before the first labels are learnt: a mouse in a room is a few hundredths of a
percent of it. Before, frames stand that the state shows (``robust.solve_frame``); of others all may move."""
NEW_LABELS = 0.01
"""Share of all Gaussians, and ..."""
MORE_LABELS = 0.2
"""... share of those that move, the smaller of which must be found moving anew before the hierarchy is built again."""


def first_labels(gaussians: Gaussians, rig: Rig, masks: Mapping[str, NDArray[np.uint8]]) -> Gaussians:
    """The Gaussians of frame 0 with the labels that the scene starts with.

    Args:
        gaussians: as they were fitted. rig: inside, at the size of the masks.
        masks: of frame 0, [H, W] by camera, not 0 on the foreground; empty where there are none.
    """
    return with_reliable_labels(with_mask_hull_labels(gaussians, rig, masks))


def with_mask_hull_labels(gaussians: Gaussians, rig: Rig, masks: Mapping[str, NDArray[np.uint8]]) -> Gaussians:
    """The Gaussians, with those in the visual hull of the masks moving as well (Laurentini 1994).

    Where no Gaussian is static, or none moves, labels say nothing of the inside, and stay.

    Args:
        gaussians, rig, masks: see ``first_labels``.
    """
    static = ~gaussians.moving
    if not masks or not static.any() or static.all():
        return gaussians
    rows = np.flatnonzero(static)
    points = gaussians.means[rows].astype(np.float64)
    held, seen = np.zeros(len(rows), np.int64), np.zeros(len(rows), np.int64)
    for camera in rig.cameras:
        if camera.name not in masks:
            continue
        column, row, _, inside = pixels_inside(camera, points)
        seen += inside
        held += inside & (masks[camera.name][row, column] > 0)
    within = (seen >= INSIDE_CAMERAS) & (held >= INSIDE_SHARE * seen)
    if not within.any():
        return gaussians
    foreground = gaussians.foreground.copy()
    foreground[rows[within]] = 1
    return gaussians.replace(foreground=foreground)


def with_reliable_labels(gaussians: Gaussians) -> Gaussians:
    """The Gaussians of frame 0, all of them moving where only a few stand.

    These few belong to an object, but no mask taught their label: they would stay behind when the object moves, and
    hide it. In a cluster that does not move they stand just as well.

    >>> state = Gaussians.of_points([[x, 0, 0] for x in range(100)], radius=0.1)
    >>> few_stand = state.replace(foreground=np.float32([0] * 5 + [1] * 95))
    >>> int(with_reliable_labels(few_stand).moving.sum())  # 5 of 100 are noise
    100
    """
    standing = int((~gaussians.moving).sum())
    if not 0 < standing < STANDING_SHARE * len(gaussians):
        return gaussians
    return gaussians.replace(foreground=np.where(gaussians.moving, gaussians.foreground, np.float32(1)))


def changed_pixels(before: Array, now: Array) -> Array:
    """[H, W] 1 where the planes [3, H, W] of two frames differ, and around; else 0.

    >>> before = np.zeros((3, 7, 7), np.float32)
    >>> now = before.copy()
    >>> now[0, 3, 3] = 0.5
    >>> int(changed_pixels(before, now).sum())  # the pixel, and five by five about it
    25
    """
    changed = (np.abs(now - before).max(axis=0) > CHANGE).astype(np.float32)
    marked: Array = maximum_filter(changed, size=REACH_PIXELS)
    return marked


def find_moving(
    gaussians: Gaussians, before: Sequence[TrainingView], now: Sequence[TrainingView], renderer: Renderer
) -> NDArray[np.bool_]:
    """[N] bool: Gaussians that the pictures of two frames show to move.

    Args:
        gaussians: Θ_{t−1}. before, now: the views of both frames; cameras of only one are left out.
        renderer: draws.
    """
    earlier = {view.name: view for view in before}
    says = np.zeros(len(gaussians), np.int64)
    asked = np.zeros(len(gaussians), np.int64)
    for view in now:
        if view.name not in earlier:
            continue
        changed = changed_pixels(earlier[view.name].target[:3], view.target[:3])
        planes = np.stack([np.ones_like(changed), changed])
        total, inside = renderer.gather(gaussians, view.camera, planes).T
        sees = total > SEEN_PIXELS
        asked += sees
        says += sees & (inside > IN_CHANGE * total)
    moving: NDArray[np.bool_] = (says >= 2) & (says > MAJORITY * asked)
    return moving


def learn_labels_from_motion(
    gaussians: Gaussians,
    known: NDArray[np.bool_] | None,
    before: Sequence[TrainingView],
    now: Sequence[TrainingView],
    renderer: Renderer,
) -> NDArray[np.bool_] | None:
    """[N] bool: Gaussians that have been seen to move by now; None where hardly any are new, or too few moved ever.

    Args:
        gaussians: Θ_{t−1}. known: [N] those that had been seen to move before, or None.
        before, now: see ``find_moving``.
    """
    moving = find_moving(gaussians, before, now, renderer)
    if known is None:
        return moving if moving.sum() >= FIRST_LABELS else None
    enough = min(NEW_LABELS * len(gaussians), max(FIRST_LABELS, MORE_LABELS * known.sum()))
    return None if (moving & ~known).sum() <= enough else moving | known


def with_labels(gaussians: Gaussians, labels: NDArray[np.bool_] | None) -> Gaussians:
    """The Gaussians with the labels [N] learnt from motion; unchanged where ``labels`` is None."""
    return gaussians if labels is None else gaussians.replace(foreground=labels.astype(np.float32))
