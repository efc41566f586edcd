"""Colours in closed form, once a frame: what the pictures have more than the render, spread over what is seen.

Each Gaussian's colour takes steps to the mean, over the pixels of some views, of what the pictures have more than the
render, weighted by the Gaussian's share of each pixel: SIRT with ordered subsets (Gilbert 1972; Hudson and Larkin
1994), whose steps of 1 do not overshoot, because the shares of a pixel add up to at most 1. The kernels are those of
the rasterizer. The last subset has the last word on what is seen otherwise from elsewhere, as something that has
entered and is in no state yet; so each subset looks from all sides, and no pixel counts for much.
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
"""Steps a frame, each from as many of the views as the others."""
MOST = 0.2
"""RGB in 0…1 that a pixel counts as more or less: what differs by more is not the light of a frame. With `visit`, which
a ball enters, subsets from one side each and no such bound cost 10 dB: frames after it were not believed."""
FEW = 1.0
"""Pixels' worth of blending weight that is added to each Gaussian's: what is hardly seen stays as it is."""


def follow_pictures(
    state: Gaussians, views: Sequence[TrainingView], renderer: Renderer, learnt: NDArray[np.uint8]
) -> Gaussians:
    """The state with the colours of some Gaussians stepped to what the pictures show.

    Args:
        state: as it is shown in the pictures. views: of the frame. renderer: draws them.
        learnt: [N] 1 for the Gaussians whose colours are stepped; the others keep theirs.
    """
    views = from_all_sides(views)
    for first in range(min(SUBSETS, len(views))):
        sums, weights = np.zeros((len(state), 3)), np.full(len(state), FEW)
        for view in views[first::SUBSETS]:
            more, seen = renderer.residuals(state, view, learnt, MOST)
            sums += more
            weights += seen
        step = (sums / weights[:, None]).astype(np.float32)
        state = state.replace(colours=state.colours + step)
    return state


def from_all_sides(views: Sequence[TrainingView]) -> list[TrainingView]:
    """The views, each next one from as far as can be from those before; whatever the order of the rig's cameras is."""
    left = sorted(views, key=attrgetter("name"))
    centres = np.array([-view.camera.pose[:, :3].T @ view.camera.pose[:, 3] for view in left])
    return [left[index] for index in farthest_first(centres, len(left))]
