"""Labels of moving Gaussians, derived from the masks of frame 0 or, without masks, from the images of two frames.

A static Gaussian inside the silhouettes of nearly all cameras is inside a moving object and moves with it. The fit
learns labels only on the outside of an object. A static Gaussian left inside becomes a ghost when the object leaves.

Without masks, a pixel counts as changed if it differs from the previous frame. A Gaussian counts as moving if it is in
changed pixels of most cameras that see it. Background behind the new position of an object changes for some cameras but
not for most.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Rig
from scas4d_core.engines.renderer import Renderer
from scas4d_core.engines.views import TrainingView
from scas4d_core.gaussians import Gaussians
from scas4d_core.posed_pictures import pixels_inside

Array = NDArray[np.float32]

CHANGE = 0.04
"""Difference of a colour channel ([0, 1]) above which a pixel has changed. Sensor and JPEG noise are smaller."""
REACH_PIXELS = 5
"""Side of the square marked around a changed pixel. The inside of a plain surface can move without changing."""
SEEN_PIXELS = 0.02
"""Blending weight of a Gaussian, in pixels, above which a camera votes on whether the Gaussian moves."""
IN_CHANGE = 0.5
"""Share of a Gaussian's weight in changed pixels above which a camera votes that it moves."""
MAJORITY = 0.5
"""Share of the voting cameras that must agree that a Gaussian moves; at least two cameras must agree."""

MIN_STATIC = 0.1
"""Minimum share of static Gaussians in a scene with a static part; below it, static labels are noise."""

INSIDE_SHARE = 0.8
"""A Gaussian counts as inside a moving object if at least this share of the masks contains its mean. Only cameras with
a mask and with the Gaussian in view are considered. Automatic masks are ragged. Values from 0.7 to 0.9 fade the ghosts
of `basketball` equally well."""
INSIDE_CAMERAS = 3
"""Minimum number of cameras for ``INSIDE_SHARE``. The intersection of two silhouettes contains much empty space."""

FIRST_LABELS = 32
"""Minimum number of moving Gaussians for learning the first labels. A mouse in a room makes up only a few hundredths of
a percent of the scene. Until then, frames that the state already explains are skipped (``robust.solve_frame``). In
other frames, all Gaussians may move."""
NEW_LABELS = 0.01
"""Share of all Gaussians that must be newly detected as moving before the hierarchy is rebuilt."""
MORE_LABELS = 0.2
"""Same as ``NEW_LABELS``, but as a share of the moving Gaussians; the smaller of the two numbers is sufficient."""


def first_labels(gaussians: Gaussians, rig: Rig, masks: Mapping[str, NDArray[np.uint8]]) -> Gaussians:
    """Returns the Gaussians of frame 0 with the initial labels of the scene.

    Args:
        gaussians: Gaussians fitted to frame 0.
        rig: rig in the internal world, at the size of the masks.
        masks: [H, W] mask of each camera in frame 0, non-zero on the foreground; empty if there are no masks.
    """
    return with_reliable_labels(with_mask_hull_labels(gaussians, rig, masks))


def with_mask_hull_labels(gaussians: Gaussians, rig: Rig, masks: Mapping[str, NDArray[np.uint8]]) -> Gaussians:
    """Returns the state with all Gaussians in the visual hull of the masks (Laurentini 1994) labelled as moving.

    If no Gaussian is static, or none moves, the labels cannot be extended and are unchanged.

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
    """Returns the Gaussians of frame 0, all labelled as moving if only a few are static.

    These few static Gaussians belong to an object, but no mask determined their label. They would stay behind and hide
    the object when it moves. A static background may safely be labelled as moving, because it forms clusters that do
    not move.

    >>> state = Gaussians.of_points([[x, 0, 0] for x in range(100)], radius=0.1)
    >>> few_static = state.replace(foreground=np.float32([0] * 5 + [1] * 95))
    >>> int(with_reliable_labels(few_static).moving.sum())  # 5 static labels in 100 are noise
    100
    """
    static_count = int((~gaussians.moving).sum())
    if not 0 < static_count < MIN_STATIC * len(gaussians):
        return gaussians
    return gaussians.replace(foreground=np.where(gaussians.moving, gaussians.foreground, np.float32(1)))


def changed_pixels(before: Array, now: Array) -> Array:
    """Returns an [H, W] map that is 1 in and around pixels that differ between two images [3, H, W], and 0 elsewhere.

    >>> before = np.zeros((3, 7, 7), np.float32)
    >>> now = before.copy()
    >>> now[0, 3, 3] = 0.5
    >>> int(changed_pixels(before, now).sum())  # a square of five by five around the pixel
    25
    """
    return _with_surroundings(np.abs(now - before).max(axis=0) > CHANGE)


def _changed_between(before: TrainingView, now: TrainingView) -> Array:
    """Returns ``changed_pixels`` of two views; faster if both were created from 8-bit images."""
    if before.source is None or now.source is None:
        return changed_pixels(before.target[:3], now.target[:3])
    from scas4d_core.kernels.pictures import mark_changes  # deferred import, because it loads the kernels

    earlier, later = np.ascontiguousarray(before.pixels), np.ascontiguousarray(now.pixels)
    changed = np.empty(later.shape[:2], np.float32)
    mark_changes(earlier, later, int(255 * CHANGE), REACH_PIXELS // 2, changed)
    return changed


def _with_surroundings(changed: NDArray[np.bool_]) -> Array:
    """Returns an [H, W] map that is 1 in and around the true pixels, and 0 elsewhere."""
    if changed.any():
        changed = _dilated(_dilated(changed).T).T
    return np.ascontiguousarray(changed, np.float32)


def _dilated(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Returns a mask that is also true up to ``REACH_PIXELS // 2`` rows from the true rows of each column."""
    wide = mask.copy()
    for shift in range(1, REACH_PIXELS // 2 + 1):
        wide[shift:] |= mask[:-shift]
        wide[:-shift] |= mask[shift:]
    return wide


def find_moving(
    gaussians: Gaussians, before: Sequence[TrainingView], now: Sequence[TrainingView], renderer: Renderer
) -> NDArray[np.bool_]:
    """Returns the [N] mask of Gaussians that move according to the images of two frames.

    Args:
        gaussians: state Θ_{t−1}.
        before, now: views of the two frames; cameras in only one of them are ignored.
        renderer: renderer that accumulates pixel values onto Gaussians.
    """
    earlier = {view.name: view for view in before}
    changes = [(view, _changed_between(earlier[view.name], view)) for view in now if view.name in earlier]
    says = np.zeros(len(gaussians), np.int64)
    asked = np.zeros(len(gaussians), np.int64)
    if sum(bool(changed.any()) for _, changed in changes) < 2:  # no two cameras can agree
        return says > 0
    for view, changed in changes:
        planes = np.stack([np.ones_like(changed), changed])
        total, in_change = renderer.gather(gaussians, view.camera, planes).T
        sees = total > np.float32(SEEN_PIXELS)
        asked += sees
        says += sees & (in_change > np.float32(IN_CHANGE) * total)
    moving: NDArray[np.bool_] = (says >= 2) & (says > MAJORITY * asked)
    return moving


def learn_labels_from_motion(
    gaussians: Gaussians,
    known: NDArray[np.bool_] | None,
    before: Sequence[TrainingView],
    now: Sequence[TrainingView],
    renderer: Renderer,
) -> NDArray[np.bool_] | None:
    """Returns the [N] mask of Gaussians that have moved so far, or None to keep the previous labels.

    The labels change only once enough Gaussians have been newly detected as moving.

    Args:
        gaussians: state Θ_{t−1}.
        known: [N] mask of Gaussians that moved in earlier frames, or None.
        before, now: views of the two frames; see ``find_moving``.
        renderer: renderer that accumulates pixel values onto Gaussians.
    """
    moving = find_moving(gaussians, before, now, renderer)
    if known is None:
        return moving if moving.sum() >= FIRST_LABELS else None
    enough = min(NEW_LABELS * len(gaussians), max(FIRST_LABELS, MORE_LABELS * known.sum()))
    return None if (moving & ~known).sum() <= enough else moving | known


def with_labels(gaussians: Gaussians, labels: NDArray[np.bool_] | None) -> Gaussians:
    """Returns the Gaussians with the labels [N] learnt from motion, or unchanged if ``labels`` is None."""
    return gaussians if labels is None else gaussians.replace(foreground=labels.astype(np.float32))
