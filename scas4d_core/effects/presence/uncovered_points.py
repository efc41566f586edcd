"""Points on uncovered surfaces: the surface around a bare region is extended across it.

In an image, the inverse depth of a plane is linear in pixel coordinates. Such a plane is fitted to the static scene
around the region. Points on the plane are accepted if the cameras agree on their colour.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, label

from scas4d_core.engines.views import LABEL
from scas4d_core.posed_pictures import pixels_inside

if TYPE_CHECKING:
    from scas4d_core.effects.presence.novelty import Novelty
    from scas4d_core.engines.renderer import Picture, Renderer
    from scas4d_core.gaussians import Gaussians

Array = NDArray[np.float32]
Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

AROUND = 6
"""Width, in pixels, of the ring around a region to which its plane is fitted."""
FEWEST = 24
"""Minimum number of ring pixels for a fit."""
OPAQUE = 0.1
"""Maximum transmittance for a pixel to have a depth."""
ROUNDS = 5
"""Number of iterations of reweighted least squares. Pixels of other surfaces around the region are outliers."""
NEAR = 0.02
"""Approximate relative deviation of an inlier from the plane, in inverse depth."""
CAMERAS, SPREAD = 3, 0.08
"""Minimum number of cameras that must see a point, and maximum mean absolute colour deviation ([0, 1]) for
agreement."""
APART = 1.3
"""Spacing of points, in pixels of the camera that sees them best."""


@dataclass(frozen=True, eq=False)
class UncoveredPoints:
    """Points on uncovered surfaces.

    Attributes:
        points: [P, 3] positions in the internal world.
        colours: [P, 3] RGB in [0, 1].
        spacing: approximate distance between neighbouring points, in metres.
    """

    points: Float
    colours: Array
    spacing: float


def find_uncovered_points(seen: Sequence[Novelty], state: Gaussians, renderer: Renderer) -> UncoveredPoints:
    """Returns points in the bare regions of all cameras.

    Args:
        seen: novelty map of each camera.
        state: state Θ_t.
        renderer: renderer for the state.
    """
    static_scene = state.retire(state.moving)
    bare = [one for one in seen if one.bare.any()]
    pictures = renderer.render_each([(static_scene, one.view.camera) for one in bare], depth_channel=LABEL)
    clouds = [_points(one, picture) for one, picture in zip(bare, pictures, strict=True)]
    points = np.concatenate(clouds) if clouds else np.zeros((0, 3))
    if not len(points):
        return UncoveredPoints(points, np.zeros((0, 3), np.float32), 0.0)
    pixel = np.full(len(points), np.inf)
    for one in seen:
        _, _, depth, inside = pixels_inside(one.camera, points)
        pixel = np.where(inside, np.minimum(pixel, depth / one.camera.fx), pixel)
    cell = APART * float(np.median(pixel))
    _, kept = np.unique(np.round(points / cell).astype(np.int64), axis=0, return_index=True)
    points = points[np.sort(kept)]
    colours, agreed = _agreed(seen, points)
    return UncoveredPoints(points[agreed], colours[agreed], cell)


def _points(one: Novelty, picture: Picture) -> Float:
    """Returns the [P, 3] surface points in the bare pixels of a camera.

    Args:
        one: novelty map of the camera.
        picture: rendering of the static scene, with the depth along z in metres in the label channel.
    """
    planes, rest = picture
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = (1 - rest) / planes[LABEL]
    known = (rest < OPAQUE) & one.behind & np.isfinite(inverse)
    regions, count = label(one.bare, np.ones((3, 3)))
    points = []
    for number in range(1, count + 1):
        region = regions == number
        ring = binary_dilation(region, iterations=AROUND) & known
        if ring.sum() >= FEWEST:
            depth = 1 / _plane(np.argwhere(ring), inverse[ring], np.argwhere(region))
            points.append(_lifted(one, np.argwhere(region), depth))
    return np.concatenate(points) if points else np.zeros((0, 3))


def _plane(at: NDArray[np.int64], values: Array, wanted: NDArray[np.int64]) -> Float:
    """Returns the [Q] values, bounded from below, at ``wanted`` pixels [Q, 2] of a plane fitted to pixels [P, 2]."""
    design = np.column_stack([at, np.ones(len(at))]).astype(np.float64)
    weights = np.ones(len(at))
    middle = max(float(np.median(values)), 1e-6)
    for _ in range(ROUNDS):
        root = np.sqrt(weights)[:, None]
        solution = np.linalg.lstsq(root * design, root[:, 0] * values, rcond=None)[0]
        weights = 1 / (1 + np.square((values - design @ solution) / (NEAR * middle)))
    depth: Float = np.maximum(np.column_stack([wanted, np.ones(len(wanted))]) @ solution, 0.1 * middle)
    return depth


def _lifted(one: Novelty, pixels: NDArray[np.int64], depth: Float) -> Float:
    """Returns the [P, 3] world points at pixels [P, 2] (row, column) and depths [P]."""
    camera = one.camera
    x = (pixels[:, 1] + 0.5 - camera.cx) / camera.fx * depth
    y = (pixels[:, 0] + 0.5 - camera.cy) / camera.fy * depth
    points: Float = (np.column_stack([x, y, depth]) - camera.translation) @ camera.rotation
    return points


def _agreed(seen: Sequence[Novelty], points: Float) -> tuple[Array, Bool]:
    """Returns the median colour [P, 3] over the cameras that see static background, and a mask [P].

    The mask selects the points that enough cameras see and on whose colour they agree.
    """
    samples = np.full((len(seen), len(points), 3), np.nan, np.float32)
    bare = np.zeros(len(points), np.int64)
    for sample, one in zip(samples, seen, strict=True):
        column, row, _, inside = pixels_inside(one.camera, points)
        use = inside & one.behind[row, column]
        sample[use] = one.image[row[use], column[use]]
        bare += inside & one.bare[row, column]
    count = np.isfinite(samples[:, :, 0]).sum(axis=0)
    colours = np.zeros((len(points), 3), np.float32)
    agreed = (count >= CAMERAS) & (bare >= CAMERAS)
    if agreed.any():
        colours[agreed] = np.nanmedian(samples[:, agreed], axis=0)
        spread = np.nanmean(np.abs(samples[:, agreed] - colours[agreed]), axis=0).max(axis=1)
        agreed[agreed] = spread < SPREAD
    return colours, agreed
