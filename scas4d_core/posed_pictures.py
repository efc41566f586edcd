"""Pictures with camera poses, and queries over several of them: visibility, occlusion, colour of points. Numpy only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Camera, Rig

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]


BLOCK = 32_768
"""Points whose colours are gathered at a time."""


class InitialPointsError(ValueError):
    """No cloud can be made: the message names the field, the value and the remedy."""


@dataclass(frozen=True, eq=False)
class PosedPicture:
    """A camera and its picture.

    Attributes:
        camera: calibrated, in the user's world.
        image: [H, W, 3] uint8.
        mask: [H, W] bool, true on the foreground; None where the capture has none.
    """

    camera: Camera
    image: NDArray[np.uint8]
    mask: Bool | None = None


def collect_views(
    rig: Rig, images: Mapping[str, NDArray[np.uint8]], masks: Mapping[str, NDArray[np.uint8]]
) -> list[PosedPicture]:
    """Views of all cameras of the rig that have a picture, in the rig's order.

    Raises:
        InitialPointsError: fewer than two pictures, or a picture or mask whose size is not its camera's.
    """
    views = []
    for camera in rig.cameras:
        if camera.name not in images:
            continue
        image = np.ascontiguousarray(images[camera.name])
        if image.shape != (camera.height, camera.width, 3) or image.dtype != np.uint8:
            raise InitialPointsError(
                f"images[{camera.name!r}]: {image.dtype} {image.shape}; "
                f"give uint8 {(camera.height, camera.width, 3)}, the size of its camera"
            )
        mask = masks.get(camera.name)
        if mask is not None and mask.shape != image.shape[:2]:
            raise InitialPointsError(
                f"masks[{camera.name!r}]: shape {mask.shape}; give {image.shape[:2]}, the size of its picture"
            )
        views.append(PosedPicture(camera, image, None if mask is None else np.asarray(mask) > 0))
    if len(views) < 2:
        raise InitialPointsError(
            f"images: {len(views)} of the rig's {len(rig)} cameras have a picture; points from pictures need at least 2"
        )
    return views


def halved(view: PosedPicture, width: int) -> PosedPicture:
    """The view at half, a quarter … of its size, until it is no wider than ``width`` pixels."""
    image, mask, camera = view.image.astype(np.float32), view.mask, view.camera
    while camera.width > width and camera.width >= 2 and camera.height >= 2:
        h, w = camera.height // 2 * 2, camera.width // 2 * 2
        image = image[:h, :w].reshape(h // 2, 2, w // 2, 2, 3).mean((1, 3))
        if mask is not None:
            mask = np.asarray(mask[:h, :w].reshape(h // 2, 2, w // 2, 2).any((1, 3)), dtype=np.bool_)
        # Blocks of 2 × 2 with pixel centres at +0.5: every pixel coordinate is halved exactly, odd sizes or not.
        matrix = camera.intrinsics * np.array([[0.5], [0.5], [1.0]])
        camera = type(camera)(camera.name, matrix, camera.world_to_camera, w // 2, h // 2)
    return PosedPicture(camera, np.rint(image).astype(np.uint8), mask)


class Posed(Protocol):
    """Whatever has a camera."""

    @property
    def camera(self) -> Camera:
        """Calibrated."""


def look_at_point(views: Sequence[Posed]) -> Float:
    """[3] point nearest to all optical axes (least squares): the middle of the stage of an inward-looking rig."""
    axes = np.array([view.camera.rotation[2] for view in views])
    centres = np.array([view.camera.centre for view in views])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal = across.sum(0) + 1e-9 * np.eye(3)
    point: Float = np.linalg.solve(normal, np.einsum("nij,nj->i", across, centres) + 1e-9 * centres.mean(0))
    return point


def pixels_inside(camera: Camera, points: Float) -> tuple[NDArray[np.intp], NDArray[np.intp], Float, Bool]:
    """Projects world points [P, 3] to whole pixels of a picture.

    Returns:
        columns, rows [P] of the pixel that holds each (0 where outside), depths [P], and which are inside [P].
    """
    uv, depth = camera.project(points)
    with np.errstate(invalid="ignore"):
        inside = (
            (depth > 0) & (uv[:, 0] >= 0) & (uv[:, 0] < camera.width) & (uv[:, 1] >= 0) & (uv[:, 1] < camera.height)
        )
    pixels = np.where(inside[:, None], uv, 0.0).astype(np.intp)
    return pixels[:, 0], pixels[:, 1], depth, inside


def front_depth(camera: Camera, occluders: Float, spacing: float, points: Float) -> Float:
    """Depth of the nearest occluder over the pixel of each point.

    Args:
        camera: that looks.
        occluders: [M, 3] world, each a disc of diameter ``spacing`` (world units) or one pixel if that is larger.
        spacing: distance of neighbouring occluders.
        points: [P, 3] world.

    Returns:
        [P] depth; infinity where the way is free, and where the point is outside the picture.
    """
    front = np.full(len(points), np.inf)
    column, line, depth, inside = pixels_inside(camera, occluders)
    if not inside.any():
        return front
    # Cells two discs wide: each holds a piece of every surface over it, and none of the neighbours' slope.
    cell = 2.0 * max(1.0, camera.fx * spacing / float(np.median(depth[inside])))
    shape = (int(camera.height / cell) + 1, int(camera.width / cell) + 1)
    nearest = np.full(shape, np.inf)
    np.minimum.at(
        nearest, ((line[inside] / cell).astype(np.intp), (column[inside] / cell).astype(np.intp)), depth[inside]
    )
    column, line, _, inside = pixels_inside(camera, points)
    front[inside] = nearest[(line[inside] / cell).astype(np.intp), (column[inside] / cell).astype(np.intp)]
    return front


def visible_from(views: Sequence[PosedPicture], points: Float, spacing: float) -> Bool:
    """Visibility of points [P, 3] in each camera; the points themselves are the occluders.

    A point is hidden if it lies more than four diameters of a disc behind the nearest one; see ``front_depth``.
    Surfaces seen at more than about 60 degrees from their normal may count as hidden: their colour is vague anyway.

    Returns:
        [V, P] bool; false also where the point projects outside the picture.
    """
    visible = np.zeros((len(views), len(points)), dtype=bool)
    for row, view in zip(visible, views, strict=True):
        _, _, depth, inside = pixels_inside(view.camera, points)
        front = front_depth(view.camera, points, spacing, points)
        row[:] = inside & (depth <= front + 4.0 * np.maximum(spacing, depth / view.camera.fx))
    return visible


@dataclass(frozen=True, eq=False)
class PointColours:
    """Colours of points over the cameras that may see them.

    Attributes:
        colours: [P, 3] float32 in 0…1, median over those cameras.
        spread: [P] median absolute deviation from it, largest channel, 0…1.
        count: [P] cameras that see the point.
    """

    colours: NDArray[np.float32]
    spread: NDArray[np.float32]
    count: NDArray[np.intp]


def observe(views: Sequence[PosedPicture], points: Float, visible: Bool) -> PointColours:
    """Median colour of points [P, 3] over the cameras in ``visible`` [V, P]; NaN where no camera sees the point."""
    if len(points) > BLOCK:  # bounds the memory of the samples
        blocks = [slice(start, start + BLOCK) for start in range(0, len(points), BLOCK)]
        parts = [observe(views, points[block], visible[:, block]) for block in blocks]
        return PointColours(
            np.concatenate([part.colours for part in parts]),
            np.concatenate([part.spread for part in parts]),
            np.concatenate([part.count for part in parts]),
        )
    samples = np.full((len(views), len(points), 3), np.nan, dtype=np.float32)
    for sample, view, seen in zip(samples, views, visible, strict=True):
        column, line, _, inside = pixels_inside(view.camera, points)
        use = seen & inside
        sample[use] = view.image[line[use], column[use]] / np.float32(255)
    count = np.isfinite(samples[..., 0]).sum(0)
    colours = np.full((len(points), 3), np.nan, dtype=np.float32)
    spread = np.full(len(points), np.nan, dtype=np.float32)
    some = count > 0
    if some.any():
        colours[some] = np.nanmedian(samples[:, some], axis=0)
        spread[some] = np.nanmedian(np.abs(samples[:, some] - colours[some]), axis=0).max(-1)
    return PointColours(colours, spread, count)
