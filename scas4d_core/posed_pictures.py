"""Images of calibrated cameras, and the visibility and colours of 3D points in several images.

This module requires only NumPy.
"""

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
"""Number of points whose colours are sampled at once, to limit memory use."""


class InitialPointsError(ValueError):
    """Raised if initial points cannot be computed. The message names the problem and the remedy."""


@dataclass(frozen=True, eq=False)
class PosedPicture:
    """A camera and its image.

    Attributes:
        camera: calibrated camera in the user's world.
        image: [H, W, 3] uint8 RGB image.
        mask: [H, W] bool, true on the foreground, or None if the image has no mask.
    """

    camera: Camera
    image: NDArray[np.uint8]
    mask: Bool | None = None


def collect_views(
    rig: Rig, images: Mapping[str, NDArray[np.uint8]], masks: Mapping[str, NDArray[np.uint8]]
) -> list[PosedPicture]:
    """Returns the images of all cameras that have one, with their cameras, in rig order.

    Args:
        rig: calibrated cameras in the user's world, at the size of the images.
        images: maps camera names to images, [H, W, 3] uint8.
        masks: maps camera names to masks, [H, W], non-zero on the foreground; may be empty.

    Raises:
        InitialPointsError: if there are fewer than two images, or an image or a mask does not have
            the size of its camera.
    """
    views = []
    for camera in rig.cameras:
        if camera.name not in images:
            continue
        image = np.ascontiguousarray(images[camera.name])
        if image.shape != (camera.height, camera.width, 3) or image.dtype != np.uint8:
            raise InitialPointsError(
                f"images[{camera.name!r}] is {image.dtype} {image.shape}; "
                f"expected uint8 {(camera.height, camera.width, 3)}, the size of its camera"
            )
        mask = masks.get(camera.name)
        if mask is not None and mask.shape != image.shape[:2]:
            raise InitialPointsError(
                f"masks[{camera.name!r}] has shape {mask.shape}; expected {image.shape[:2]}, the size of its image"
            )
        views.append(PosedPicture(camera, image, None if mask is None else np.asarray(mask) > 0))
    if len(views) < 2:
        raise InitialPointsError(
            f"images: only {len(views)} of the rig's {len(rig)} cameras have an image; initial points require 2 or more"
        )
    return views


def halved(view: PosedPicture, width: int) -> PosedPicture:
    """Halves the size of a view repeatedly until its image is at most ``width`` pixels wide.

    A pixel of the smaller mask is foreground if any of its four original pixels is foreground.
    """
    image, mask, camera = view.image.astype(np.float32), view.mask, view.camera
    while camera.width > width and camera.width >= 2 and camera.height >= 2:
        h, w = camera.height // 2 * 2, camera.width // 2 * 2
        image = image[:h, :w].reshape(h // 2, 2, w // 2, 2, 3).mean((1, 3))
        if mask is not None:
            mask = np.asarray(mask[:h, :w].reshape(h // 2, 2, w // 2, 2).any((1, 3)), dtype=np.bool_)
        # The blocks of 2 × 2 pixels start at the upper left corner, and pixel centres are at +0.5.
        # Every pixel coordinate is therefore halved exactly, even for odd sizes.
        matrix = camera.intrinsics * np.array([[0.5], [0.5], [1.0]])
        camera = type(camera)(camera.name, matrix, camera.world_to_camera, w // 2, h // 2)
    return PosedPicture(camera, np.rint(image).astype(np.uint8), mask)


class Posed(Protocol):
    """Protocol of objects that have a camera."""

    @property
    def camera(self) -> Camera:
        """Calibrated camera."""


def look_at_point(views: Sequence[Posed]) -> Float:
    """Returns the [3] point nearest to all optical axes, in the least-squares sense.

    For a rig of inward-looking cameras, this point is at the centre of the observed scene.
    """
    axes = np.array([view.camera.rotation[2] for view in views])
    centres = np.array([view.camera.centre for view in views])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal = across.sum(0) + 1e-9 * np.eye(3)
    point: Float = np.linalg.solve(normal, np.einsum("nij,nj->i", across, centres) + 1e-9 * centres.mean(0))
    return point


def pixels_inside(camera: Camera, points: Float) -> tuple[NDArray[np.intp], NDArray[np.intp], Float, Bool]:
    """Returns the pixel of an image to which each world point [P, 3] projects.

    Returns:
        Four arrays [P]: the column and the row of each point (0 if the point is outside the image),
        the depth of the point, and whether the point is in front of the camera and inside the
        image.
    """
    uv, depth = camera.project(points)
    inside = camera.in_image(uv)
    pixels = np.where(inside[:, None], uv, 0.0).astype(np.intp)
    return pixels[:, 0], pixels[:, 1], depth, inside


def front_depth(camera: Camera, occluders: Float, spacing: float, points: Float) -> Float:
    """Returns the depth of the nearest occluder at the pixel of each point.

    Args:
        camera: viewing camera.
        occluders: [M, 3] world positions of discs, whose diameter is ``spacing`` or one pixel,
            whichever is larger.
        spacing: distance between neighbouring occluders, in world units.
        points: [P, 3] world positions of the points.

    Returns:
        [P] depths; infinite if the pixel has no occluder, or the point is outside the image.
    """
    front = np.full(len(points), np.inf)
    column, line, depth, inside = pixels_inside(camera, occluders)
    if not inside.any():
        return front
    # The image is divided into cells that are two discs wide. A cell contains a point of every
    # surface that covers the cell, and is so small that the depth of a slope hardly varies.
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
    """Returns whether each point is visible in each view.

    The points themselves are the occluders. A point is hidden if it is more than four disc
    diameters behind the nearest point at its pixel; see ``front_depth``. A surface that is seen at
    more than about 60 degrees from its normal may count as hidden. The colour of such a surface is
    unreliable anyway.

    Args:
        views: V views.
        points: [P, 3] world positions of the points.
        spacing: distance between neighbouring points, in world units.

    Returns:
        [V, P] bool; false also for points that project outside the image.
    """
    visible = np.zeros((len(views), len(points)), dtype=bool)
    for row, view in zip(visible, views, strict=True):
        _, _, depth, inside = pixels_inside(view.camera, points)
        front = front_depth(view.camera, points, spacing, points)
        row[:] = inside & (depth <= front + 4.0 * np.maximum(spacing, depth / view.camera.fx))
    return visible


@dataclass(frozen=True, eq=False)
class PointColours:
    """Colours of points, combined over all cameras that see each point.

    Attributes:
        colours: [P, 3] float32 median RGB over the cameras that see the point, [0, 1].
        spread: [P] median absolute deviation from ``colours`` over these cameras, [0, 1]. The channel
            with the largest deviation counts.
        count: [P] number of cameras that see each point.
    """

    colours: NDArray[np.float32]
    spread: NDArray[np.float32]
    count: NDArray[np.intp]


def observe(views: Sequence[PosedPicture], points: Float, visible: Bool) -> PointColours:
    """Returns the colours of points in several views.

    Points that no camera sees have the colour NaN.

    Args:
        views: V views.
        points: [P, 3] world positions of the points.
        visible: [V, P] bool, whether each point is visible in each view.
    """
    if len(points) > BLOCK:  # points are processed in blocks, to limit the memory of the samples
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
