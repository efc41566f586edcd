"""Closed-form colour updates, once per frame, that distribute the image residuals over the visible Gaussians.

Each step changes a Gaussian's colour by the mean residual (image minus rendering) over the pixels of some views,
weighted by the Gaussian's share of each pixel. This is SIRT with ordered subsets (Gilbert 1972; Hudson and Larkin
1994). Steps of size 1 do not overshoot, because the shares of a pixel sum to at most 1. The kernels are shared
with the rasterizer. Where views disagree, for example at a new object that the state does not contain yet, the last
subset dominates. Each subset therefore contains views from all sides, and each pixel's residual is clamped.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import farthest_first
from scas4d_core.gaussians import Gaussians

if TYPE_CHECKING:
    from scas4d_core.engines.renderer import Renderer
    from scas4d_core.engines.views import TrainingView

SUBSETS = 6
"""Number of steps per frame; the views are divided evenly among them."""
MOST = 0.2
"""Limit on the residual of a pixel, RGB in [0, 1]. Larger differences are not due to lighting. On `visit`, in which
a ball enters, one-sided subsets without this limit cost 10 dB, and later frames were rejected."""


def follow_pictures(
    state: Gaussians, views: Sequence[TrainingView], renderer: Renderer, learnt: NDArray[np.uint8]
) -> Gaussians:
    """Returns the state with the colours of some Gaussians updated to match the images.

    Args:
        state: state whose geometry already matches the images.
        views: training views of the frame.
        renderer: renderer that computes the residuals.
        learnt: [N] mask that is 1 for Gaussians whose colours are updated, and 0 for all others.
    """
    views = from_all_sides(views)
    subsets = [views[first::SUBSETS] for first in range(min(SUBSETS, len(views)))]
    return renderer.step_colours(state, subsets, learnt, MOST)


def from_all_sides(views: Sequence[TrainingView]) -> list[TrainingView]:
    """Returns the views in farthest-first order, independent of the order of the rig's cameras."""
    left = sorted(views, key=attrgetter("name"))
    centres = np.array([-view.camera.pose[:, :3].T @ view.camera.pose[:, 3] for view in left])
    return [left[index] for index in farthest_first(centres, len(left))]
