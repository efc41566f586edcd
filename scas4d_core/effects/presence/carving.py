"""Hull of new objects: voxels that several cameras see as new and few cameras see as free.

The hull is carved from an octree, like the visual hull of frame 0. Each camera contributes a silhouette, which is
ignored at pixels in which a moving object of the state may hide the new one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt, label

from scas4d_core.posed_pictures import front_depth, look_at_point, pixels_inside

if TYPE_CHECKING:
    from scas4d_core.effects.presence.novelty import Novelty

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

AGREE = 4
"""Minimum number of cameras that see a voxel as new. In a rig of twenty cameras, three can agree on a ghost."""
MISSES = 0.1
"""Maximum share of cameras that see a voxel as free, among the cameras that see it as free or new. Outlines can be off
by a pixel."""
COARSE = 32
"""Number of voxels along an edge of the first grid."""
VOXEL_PIXELS = 1.5
"""Maximum edge of the smallest voxel, in pixels at the centre of the scene."""
MAX_CELLS = 1 << 24
"""Maximum number of cells in the grid that separates new objects. Voxels that would require a larger grid are
discarded."""
MAX_VOXELS = 1_000_000
"""Maximum number of voxels in a level; refinement stops before this limit is exceeded."""
AT_ONCE = 1 << 16
"""Number of voxels that are tested at once; each needs 200 bytes of temporary memory."""
SMALLEST = 27
"""Minimum number of voxels in an object: three along each edge."""
SIDES = np.stack(np.meshgrid(*[np.arange(2, dtype=np.int32)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class Hull:
    """Voxels of new objects.

    Attributes:
        points: [V, 3] voxel centres in the internal world.
        surface: [V] mask of voxels with an empty neighbour.
        things: [V] object number of each voxel; connected voxels have the same number.
        voxel: edge length of a voxel, in metres.
    """

    points: Float
    surface: Bool
    things: NDArray[np.int64]
    voxel: float

    def only(self, kept: Bool) -> Hull:
        """Returns the hull with only the voxels selected by the mask ``kept`` [V]."""
        return Hull(self.points[kept], self.surface[kept], self.things[kept], self.voxel)


def carve_new(seen: Sequence[Novelty]) -> Hull:
    """Returns the hull of new objects, carved from a cube around the scene centre that contains all cameras.

    Args:
        seen: novelty map of each camera.
    """
    middle = look_at_point(seen)
    reach = max(float(np.linalg.norm(one.camera.centre - middle)) for one in seen)
    pixel = float(np.median([_depth_of(one, middle) / one.camera.fx for one in seen]))
    voxel = 2 * reach / COARSE
    origin = middle - reach + voxel / 2
    cells = np.stack(np.meshgrid(*[np.arange(COARSE, dtype=np.int32)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    distances = [(_distance(one.new), _distance(one.new | one.covered)) for one in seen]
    while True:
        last = voxel <= VOXEL_PIXELS * pixel or 8 * len(cells) > MAX_VOXELS
        parts = np.split(cells, range(AT_ONCE, len(cells), AT_ONCE))
        cells = cells[np.concatenate([_kept(seen, distances, origin + part * voxel, voxel, last) for part in parts])]
        if last or len(cells) == 0:
            return _hull(cells, origin, voxel)
        cells = (2 * cells[:, None, :] + SIDES).reshape(-1, 3)
        origin = origin - voxel / 4
        voxel /= 2


def _depth_of(one: Novelty, point: Float) -> float:
    return max(float(one.camera.project(point)[1]), 1e-3)


def _distance(pixels: Bool) -> Float:
    """Returns the [H, W] distance of each pixel to the nearest true pixel, in pixels, or infinity if there is none."""
    if not pixels.any():
        return np.full(pixels.shape, np.inf)
    result: Float = distance_transform_edt(~pixels)
    return result


def _kept(
    seen: Sequence[Novelty], distances: Sequence[tuple[Float, Float]], centres: Float, voxel: float, last: bool
) -> Bool:
    agree, against, asked = (np.zeros(len(centres), np.int64) for _ in range(3))
    half = 0.5 * voxel if last else 0.5 * np.sqrt(3.0) * voxel
    for one, (new, possible) in zip(seen, distances, strict=True):
        camera = one.camera
        uv, depth = camera.project(centres)
        # Before the last level, a voxel is kept if any part of it may be new, including parts beyond the image border.
        slack = camera.fx * half / np.maximum(depth, 1e-9) + (0.71 if last else 1.5)
        border = 0.0 if last else slack
        with np.errstate(invalid="ignore"):
            near = (depth > half) & (uv[:, 0] >= -border) & (uv[:, 0] < camera.width + border)
            near &= (uv[:, 1] >= -border) & (uv[:, 1] < camera.height + border)
            clipped = np.clip(np.where(near[:, None], uv, 0), 0, [camera.width - 1, camera.height - 1])
        column, row = clipped.astype(np.int64).T
        agree += near & (new[row, column] <= slack)
        missed = near & (possible[row, column] > slack)
        if not last:
            missed &= camera.in_image(uv)
        against += missed
        asked += missed | (near & (new[row, column] <= slack))
    kept: Bool = (agree >= AGREE) & (against <= np.floor(MISSES * asked))
    return kept


def _hull(cells: NDArray[np.int32], origin: Float, voxel: float) -> Hull:
    if len(cells) == 0:
        return Hull(np.zeros((0, 3)), np.zeros(0, np.bool_), np.zeros(0, np.int64), voxel)
    # Gaps between distant objects are reduced to one empty layer, so that the grid stays small.
    close = np.stack([without_gaps(column) for column in cells.T], axis=1)
    shape = close.max(axis=0) + 2
    if np.prod(shape) > MAX_CELLS:
        return _hull(cells[:0], origin, voxel)
    grid = np.zeros(shape, np.bool_)
    at = tuple(close.T)
    grid[at] = True
    numbers, _ = label(grid, np.ones((3, 3, 3)))
    inner = grid.copy()
    for axis in range(3):
        for step in (1, -1):
            inner &= np.roll(grid, step, axis)
    things = numbers[at].astype(np.int64)
    kept = np.bincount(things)[things] >= SMALLEST
    return Hull((origin + cells * voxel)[kept], ~inner[at][kept], things[kept], voxel)


def without_gaps(places: NDArray[np.integer]) -> NDArray[np.int64]:
    """Returns positions along an axis, renumbered from 1 with one empty position per gap.

    >>> without_gaps(np.array([7, -900, 8, 30]))
    array([3, 1, 4, 6])
    """
    known, which = np.unique(places, return_inverse=True)
    steps = np.minimum(np.diff(known, prepend=known[0] - 1), 2)
    moved: NDArray[np.int64] = np.cumsum(steps)[which]
    return moved


def footprint(one: Novelty, points: Float, voxel: float) -> Bool:
    """Returns the [H, W] mask of a camera's pixels that are covered by voxels with centres [P, 3]."""
    column, row, depth, inside = pixels_inside(one.camera, points)
    shown = np.zeros(one.new.shape, np.bool_)
    shown[row[inside], column[inside]] = True
    if not inside.any():
        return shown
    wide = 1 + int(np.ceil(one.camera.fx * voxel / float(np.median(depth[inside]))))
    dilated: Bool = binary_dilation(shown, np.ones((2 * (wide // 2) + 1,) * 2, np.bool_))
    return dilated


def colours_of(seen: Sequence[Novelty], points: Float, hull: Hull) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Returns each point's median colour [P, 3] over the cameras that see it as new, and the number of cameras [P].

    The colour is NaN if no camera sees the point as new.

    Args:
        seen: novelty map of each camera.
        points: [P, 3] points on the hull's surface.
        hull: hull that may occlude the points.
    """
    samples = np.full((len(seen), len(points), 3), np.nan, np.float32)
    front = hull.points[hull.surface]
    for sample, one in zip(samples, seen, strict=True):
        column, row, depth, inside = pixels_inside(one.camera, points)
        free = depth <= front_depth(one.camera, front, hull.voxel, points) + 2 * hull.voxel
        use = inside & free & one.new[row, column]
        sample[use] = one.image[row[use], column[use]]
    count = np.isfinite(samples[:, :, 0]).sum(axis=0)
    colours = np.full((len(points), 3), np.nan, np.float32)
    if (count > 0).any():
        colours[count > 0] = np.nanmedian(samples[:, count > 0], axis=0)
    return colours, count
