"""Search for dirt on a lens: a region of one image that is brighter or darker than the other cameras suggest.

Dirt scatters light or blocks it. It hardly changes the PSNR of an image, so the search compares brightness instead.
Errors that other cameras confirm do not count. ``alarms`` starts the search if the mean brightness of an image has
changed for several frames, and raises the alarm. No search is made if the time budget of the frame is spent.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import label, uniform_filter

from scas4d_core.robust.confirmed_errors import MAX_WITNESSES, ImageErrors
from scas4d_core.update.best_state import spread_cameras

SHIFTED = 0.04
"""Minimum difference in brightness, [0, 1], of a cell in the region."""
SMOOTHED = 4
"""Size of the window, in cells, over which differences are averaged."""
SHARE = 0.03
"""Minimum size of the region, as a share of the image."""
STATIC_SHARE = 0.005
"""Minimum size of the part of the region that shows static content, as a share of the image. A region that shows only
moving content may be an error of the update."""
FEWEST_CAMERAS = 4
"""Minimum number of cameras. With fewer, no two others could confirm what an image shows."""


class ShiftedRegion(NamedTuple):
    """Region of an image that is brighter or darker than the state.

    Attributes:
        share: size of the region, as a share of the image.
        static: size of its part with static content, as a share of the image.
        level: mean difference between the image and the state in the region, in [-1, 1].
    """

    share: float
    static: float
    level: float

    @property
    def is_dirt(self) -> bool:
        """Whether the region is large enough, and includes enough static content."""
        return self.share >= SHARE and self.static >= STATIC_SHARE


def shifted_region(images: ImageErrors, name: str) -> ShiftedRegion | None:
    """Returns the largest connected region of a camera's image that is brighter, or darker, by ``SHIFTED``.

    Args:
        images: errors of the state after the update, in the images that were used for the frame.
        name: name of the camera.

    Returns:
        The region, whose share is 0 if there is none; or None if the camera was not used for the frame, or too few
        cameras were.
    """
    if name not in images.names or len(images.names) < FEWEST_CAMERAS:
        return None
    witnesses = spread_cameras(images.rig, [other for other in images.names if other != name], MAX_WITNESSES)
    own, confirmed = images.errors(name), images.confirmed(name, witnesses)
    smooth = uniform_filter(np.where(confirmed, 0, own.differences), SMOOTHED, mode="nearest")
    best = ShiftedRegion(0.0, 0.0, 0.0)
    for sign in (1, -1):
        regions, _ = label(sign * smooth > SHIFTED)
        sizes = np.bincount(regions.ravel())[1:]
        if sizes.size and (share := float(sizes.max() / regions.size)) > best.share:
            region = regions == 1 + sizes.argmax()
            best = ShiftedRegion(share, float((region & own.static).mean()), float(smooth[region].mean()))
    return best
