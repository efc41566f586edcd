"""Leaving objects: moving Gaussians are retired when they and their neighbourhood are outside all images.

Retired Gaussians keep their rows and ids. They are neither rendered nor moved until an object that they explain comes
into view.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scas4d_core.effects.effect import Effect, EffectGroup
from scas4d_core.effects.evidence import Evidence
from scas4d_core.gaussians import Gaussians, moving_extent

if TYPE_CHECKING:
    from scas4d_core.cameras import Rig
    from scas4d_core.effects.evidence import FrameObservation
    from scas4d_core.update.parts import Arrays, PlanBuilder
    from scas4d_core.update.result import UpdateResult

NAME = "leaving"
SHARE, IDLE_SHARE = 0.02, 0.002
"""Share of moving Gaussians outside all images at which the effect is switched on, and share below which it may be
switched off."""
FRAMES = 2
"""Number of consecutive frames outside all images before a Gaussian is retired. Objects at the border may reappear."""
ABOUT = 0.1
"""Distance within which a visible Gaussian keeps its neighbours from being retired, relative to the extent of the
moving Gaussians. The visible half of an object still guides the other half."""
WIDTHS = 3.0
"""Extent of a Gaussian in standard deviations. The entire extent must be outside an image."""


def outside_all_views(state: Gaussians, rig: Rig) -> NDArray[np.bool_]:
    """Returns the [N] mask of moving Gaussians that are outside all images.

    Args:
        state: state Θ_t.
        rig: cameras in the internal world, including excluded cameras, which may be accepted again.
    """
    rows = np.flatnonzero(state.moving)
    # Gaussians that are held back may not be finite, and depths may be 0.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        longest = np.fmax.reduce(np.square(state.factors[rows]).sum(axis=1), axis=1, initial=0)
        extent = WIDTHS * np.sqrt(longest).astype(np.float64)
        for camera in rig.cameras:  # most Gaussians are inside the first image
            pose = camera.world_to_camera
            x, y, z = state.means[rows].astype(np.float64).T
            across, down, depth = (pose[k, 0] * x + pose[k, 1] * y + pose[k, 2] * z + pose[k, 3] for k in range(3))
            u, v = camera.fx * across / depth + camera.cx, camera.fy * down / depth + camera.cy
            border = camera.fx * extent / depth
            inside = (depth > 0) & (u > -border) & (u < camera.width + border)
            inside &= (v > -border) & (v < camera.height + border)
            rows, extent = rows[~inside], extent[~inside]
    outside = np.zeros(len(state), np.bool_)
    outside[rows] = True
    return outside


@dataclass(frozen=True)
class Leaving(Effect):
    """Retires Gaussians that have left all views."""

    def evidence(self, seen: FrameObservation) -> Evidence | None:
        """Returns the share of moving Gaussians outside all images, or the recorded share while any are retired."""
        if not seen.views:
            return None
        state = seen.result.gaussians
        left = seen.result.carried.get(NAME)
        if left is not None and state.retired.any():
            return _evidence(float(left["share"]))
        moving = int(state.moving.sum())
        return _evidence(float(outside_all_views(state, seen.rig).sum()) / max(1, moving))

    def add_and_retire_gaussians(self, seen: FrameObservation) -> UpdateResult:
        """Retires the Gaussians that have been outside all images for long enough."""
        state = seen.result.gaussians
        out = outside_all_views(state, seen.rig)
        left: Arrays = dict(seen.result.carried.get(NAME, {}))
        before = left.get("frames", np.zeros(0, np.int64))
        frames = np.where(out, 1 + np.pad(before, (0, len(out) - len(before))), 0)
        gone = frames >= FRAMES
        inside = state.moving & ~out
        if gone.any() and inside.any():
            near = ABOUT * moving_extent(state.replace(foreground=np.where(inside, state.foreground, np.float32(0))))
            rows = np.flatnonzero(gone)
            gone[rows] = cKDTree(state.means[inside]).query(state.means[rows])[0] > near
        share = float(gone.sum()) / max(1, int(state.moving.sum()))
        arrays = {"frames": frames, "share": np.maximum(left.get("share", np.array(0.0)), share)}
        carried = {**seen.result.carried, NAME: arrays}
        return replace(seen.result, gaussians=state.retire(gone) if gone.any() else state, carried=carried)

    def register(self, builder: PlanBuilder) -> None:
        """Does nothing, because Gaussians are retired after a frame's update."""


def _evidence(share: float) -> Evidence:
    return Evidence(share, f"{100 * share:.0f}% of the moving Gaussians are outside all images" if share else "")


EFFECT = Leaving(
    name=NAME,
    group=EffectGroup.PRESENCE,
    description="Objects leave the scene: Gaussians outside all images are retired, and may return with their ids.",
    disambiguation="None needed: Gaussians outside all images explain no pixels.",
    cost="one projection of the moving Gaussians per frame; updates are cheaper without the retired Gaussians",
    auto=True,
    on_above=SHARE,
    off_below=IDLE_SHARE,
    committed_arrays=("share",),
)
