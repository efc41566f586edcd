"""Visual hull: the largest shape that agrees with the masks (Laurentini 1994), as voxels.

The voxels are refined like an octree. A camera is ignored for voxels outside its image. A voxel is
kept only if at least ``min_views`` cameras see the voxel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt

from scas4d_core.posed_pictures import (
    Bool,
    Float,
    PosedPicture,
    front_depth,
    look_at_point,
    pixels_inside,
)

SEEN_SHARE = 0.35
"""Minimum fraction of the masked cameras that must see a voxel. The limit avoids ghosts where few
cameras see the scene."""
VOXEL_PIXELS = 1.5
"""Maximum edge length of the smallest voxels, in pixels at the scene centre."""
MISSES = 0.05
"""Maximum fraction of the cameras whose masks may miss a voxel, because automatic masks are ragged.
For silhouettes in front of a plain background, which are exact, the fraction is 0."""
COARSE = 32
"""Number of voxels along an edge of the first, coarsest grid."""
MAX_VOXELS = 4_000_000
"""Maximum number of voxels per level, which bounds memory. Refinement stops before this number is
exceeded."""


@dataclass(frozen=True, eq=False)
class VisualHull:
    """Voxels inside the silhouettes of all cameras that see them.

    Attributes:
        cells: [M, 3] integer grid indices of the voxels.
        origin: [3] centre of the voxel with index (0, 0, 0).
        voxel: edge length of a voxel, in world units.
    """

    cells: NDArray[np.int64]
    origin: Float
    voxel: float

    @property
    def centres(self) -> Float:
        """[M, 3] voxel centres in the world."""
        result: Float = self.origin + self.cells * self.voxel
        return result

    @property
    def volume(self) -> float:
        """Volume of the hull, in cubic world units."""
        return len(self.cells) * self.voxel**3

    def is_near(self, points: Float) -> Bool:
        """Returns whether each of the points [P, 3] is inside the hull or within about two voxels of it, [P]."""
        low, size, strides, keys = self._surroundings
        at = np.floor((points - self.origin) / self.voxel + 0.5).astype(np.int64) // 2
        near = ((at > low) & (at < low + size - 1)).all(axis=1)
        mine = (at - low) @ strides
        result: Bool = near & (keys[np.searchsorted(keys, mine).clip(max=len(keys) - 1)] == mine)
        return result

    @cached_property
    def _surroundings(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Half-resolution grid of the cells that are in or next to the hull.

        The four values are the lowest cell, the size, the strides and the sorted keys of the cells.
        The grid is cached, because stereo uses the grid for every image, and the hull may have
        millions of voxels.
        """
        halved = self.cells // 2
        low = halved.min(0) - 2
        size = halved.max(0) + 3 - low
        strides = np.array([size[1] * size[2], size[2], 1])
        keys = np.unique((halved - low) @ strides)
        for stride in strides:
            keys = np.unique(np.concatenate([keys - stride, keys, keys + stride]))
        return low, size, strides, keys

    def surface(self) -> Bool:
        """Returns whether each voxel is on the surface, [M].

        At least one of the six neighbours of a surface voxel is empty.
        """
        if len(self.cells) == 0:
            return np.zeros(0, dtype=bool)
        low = self.cells.min(0) - 1
        size = self.cells.max(0) + 2 - low
        steps = np.array([size[1] * size[2], size[2], 1])
        keys = np.sort((self.cells - low) @ steps)
        mine = (self.cells - low) @ steps
        bare = np.zeros(len(mine), dtype=bool)
        for step in (*steps, *-steps):
            at = np.searchsorted(keys, mine + step).clip(max=len(keys) - 1)
            bare |= keys[at] != mine + step
        return bare


def pixel_size_at(views: Sequence[PosedPicture], point: Float) -> float:
    """Returns the size of a pixel at ``point`` [3], in world units.

    The result is the median over the cameras that face the point, or 1 if no camera does.
    """
    sizes = [
        float(view.camera.project(point)[1]) / view.camera.fx for view in views if view.camera.project(point)[1] > 0
    ]
    return float(np.median(sizes)) if sizes else 1.0


def carve(
    views: Sequence[PosedPicture], *, voxel_pixels: float = VOXEL_PIXELS, misses: float = 0.0, min_views: int = 3
) -> VisualHull:
    """Carves the visual hull of the masks.

    Args:
        views: views of the cameras. Views without a mask are ignored.
        voxel_pixels: edge length, in pixels at the scene centre, at which voxels are no longer
            subdivided.
        misses: maximum fraction of the cameras whose masks do not contain a voxel, among the
            cameras that see the voxel.
        min_views: minimum number of cameras that must see a voxel. At least ``SEEN_SHARE`` of the
            masked cameras must also see the voxel.
    """
    masked = [view for view in views if view.mask is not None]
    middle = look_at_point(views)
    reach = max(float(np.linalg.norm(view.camera.centre - middle)) for view in views)
    voxel = 2.0 * reach / COARSE
    origin = middle - reach + voxel / 2
    cells = np.stack(np.meshgrid(*[np.arange(COARSE)] * 3, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.int64)
    if len(masked) < 2:
        return VisualHull(cells[:0], origin, voxel)
    distances = [_distance(np.asarray(view.mask)) for view in masked]
    min_views = max(min_views, int(SEEN_SHARE * len(masked)))
    target = voxel_pixels * pixel_size_at(views, middle)
    while True:
        last = voxel <= target or 8 * len(cells) > MAX_VOXELS
        cells = cells[_inside_silhouettes(masked, distances, origin + cells * voxel, voxel, misses, min_views, last)]
        if last or len(cells) == 0:
            return VisualHull(cells, origin, voxel)
        children = np.stack(np.meshgrid(*[np.arange(2)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        cells = (2 * cells[:, None, :] + children).reshape(-1, 3)
        origin = origin - voxel / 4
        voxel /= 2


def count_contradictions(
    views: Sequence[PosedPicture], hull: VisualHull, points: Float, misses: float
) -> NDArray[np.intp]:
    """Returns the number of masks [P] that contradict each point.

    A point within the silhouettes is foreground and is not contradicted. Any other point is
    background. A mask contradicts a background point that is in front of the hull at a foreground
    pixel. Stereo produces such points next to outlines, where a patch covers both foreground and
    background.

    Args:
        views: views of the cameras. Views without a mask are ignored.
        hull: hull of the masks.
        points: [P, 3] points in the world.
        misses: maximum fraction of the masks that may miss a foreground point.
    """
    surface = hull.centres[hull.surface()]
    against, missed, seen = (np.zeros(len(points), dtype=np.intp) for _ in range(3))
    for view in views:
        if view.mask is None:
            continue
        column, line, depth, inside = pixels_inside(view.camera, points)
        seen += inside
        missed += inside & ~binary_dilation(view.mask, iterations=1)[line, column]
        before = depth < front_depth(view.camera, surface, hull.voxel, points) - 2.0 * hull.voxel
        against += inside & before & binary_erosion(view.mask, iterations=1)[line, column]
    against[missed <= np.floor(misses * seen)] = 0
    return against


def _distance(mask: Bool) -> Float:
    """Returns the distance [H, W] in pixels to the silhouette, or infinity if the mask is empty."""
    if not mask.any():
        return np.full(mask.shape, np.inf)
    result: Float = distance_transform_edt(~mask)
    return result


def _inside_silhouettes(
    views: Sequence[PosedPicture],
    distances: Sequence[Float],
    centres: Float,
    voxel: float,
    misses: float,
    min_views: int,
    last: bool,
) -> Bool:
    """Returns whether each voxel is kept on a level of the octree, [M].

    A voxel is kept if enough cameras see the voxel, and at most the fraction ``misses`` of these
    cameras see the voxel outside the silhouette.
    """
    missed = np.zeros(len(centres), dtype=np.int32)
    seen = np.zeros(len(centres), dtype=np.int32)
    may_see = np.zeros(len(centres), dtype=np.int32)
    for view, distance in zip(views, distances, strict=True):
        camera = view.camera
        column, line, depth, inside = pixels_inside(camera, centres)
        # Before the last level, a voxel is kept if any part of the voxel may be in the silhouette.
        # The slack is half the diagonal of the voxel plus 1.5 pixels. On the last level, the centre
        # of the voxel decides, with a slack of half a voxel plus half the diagonal of a pixel.
        # Masks are sampled at pixel centres. If many masks had to agree exactly, rounding errors
        # would carve into the hull.
        half = 0.5 * voxel if last else 0.5 * np.sqrt(3.0) * voxel
        slack = camera.fx * half / np.maximum(depth, 1e-9) + (0.71 if last else 1.5)
        judged = inside & (depth > half)
        missed += judged & (distance[line, column] > slack)
        seen += judged
        if not last:
            uv, _ = camera.project(centres)
            with np.errstate(invalid="ignore"):
                near = (uv > -slack[:, None]) & (uv < np.array([camera.width, camera.height]) + slack[:, None])
            may_see += near.all(axis=1) | (np.abs(depth) <= half)
    enough = seen if last else may_see
    kept: Bool = (missed <= np.floor(misses * seen)) & (enough >= min_views)
    return kept
