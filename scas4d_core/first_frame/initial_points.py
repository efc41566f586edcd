"""Initial points: a point cloud from the images of frame 0 and calibrated cameras, by several methods."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scas4d_core.cameras import Rig
from scas4d_core.captures.frame import InitialPoints
from scas4d_core.first_frame.points.agreement import PointSearch, find_agreeing_points
from scas4d_core.first_frame.points.merging import SPACING
from scas4d_core.first_frame.points.plane import plane_points
from scas4d_core.first_frame.points.silhouettes import backdrop, plain_background, with_silhouettes
from scas4d_core.first_frame.points.stereo import ITERATIONS
from scas4d_core.first_frame.points.surroundings import Stage, surroundings
from scas4d_core.first_frame.points.triangulation import match_tracks, triangulate
from scas4d_core.first_frame.points.visual_hull import pixel_size_at
from scas4d_core.first_frame.points.volume import shared_volume, stage_distances
from scas4d_core.first_frame.time_limit import TimeLimit
from scas4d_core.frame_outcome import COVERS_LITTLE
from scas4d_core.posed_pictures import (
    InitialPointsError,
    PosedPicture,
    collect_views,
    look_at_point,
    pixels_inside,
)

OnProgress = Callable[[str, int, int], None]
"""Called with a stage, the completed steps and the total steps."""

MAX_POINTS = 60_000
"""Maximum number of points; if there are more, the spacing is increased."""
MIN_VIEWS = 3
"""Minimum number of cameras that must agree on a point: two always meet somewhere on an epipolar line."""
CELLS = 32
"""Number of cells along the longer side of an image, for measuring coverage."""
ENOUGH_COVERAGE = COVERS_LITTLE
"""Share of cells with a point, in most images, at which a cloud is sufficient and no other method is tried. Captures of
at least eighteen cameras have 0.99 to 1; sparse rigs of four to seven have 0 to 0.4 without other methods."""
LITTLE_COVERAGE = 0.05
"""Coverage up to which unconfirmed points are better than none."""


@dataclass(eq=False)
class InitialCloud(InitialPoints):
    """Initial points, and the method that found them.

    Attributes:
        method: one or more of these, joined by " + ". "agreement": at least three cameras agree. "backdrop":
            silhouettes in front of a plain backdrop. "pairs": two cameras agree. "plane": a floor or table on which
            images agree. "surroundings": the images, far behind the scene. "volume": the volume that cameras share; no
            point is confirmed.
        coverage: share of image cells with a point that cameras agree on, median over the cameras.
        stage: region that the surroundings enclose; None without surroundings.
    """

    method: str = "agreement"
    coverage: float = 0.0
    stage: Stage | None = None


def initial_points(
    rig: Rig,
    images: Mapping[str, NDArray[np.uint8]],
    masks: Mapping[str, NDArray[np.uint8]],
    progress: OnProgress | None = None,
    *,
    max_points: int = MAX_POINTS,
    stereo: bool = True,
    stereo_iterations: int = ITERATIONS,
    seed: int = 0,
    limit: TimeLimit | None = None,
) -> InitialCloud:
    """Finds points on the surfaces that the images of one frame show.

    Triangulated features bound the scene and support walls and floors. PatchMatch stereo adds textured surfaces; its
    points are kept if at least ``MIN_VIEWS`` cameras agree and few see through them. The visual hull (of the masks, or
    of silhouettes in front of a plain background) and fitted surfaces add the rest. These may cover too little of the
    images, as with a few widely spaced cameras. In this case, further methods are tried in turn. They use silhouettes
    in front of a backdrop that does not fill the image borders, points on which two cameras agree, and a plane on which
    images agree. Finally, the images themselves are placed far behind the scene. If almost nothing is found, points
    fill the volume that the cameras share.

    Args:
        rig: calibrated cameras, in the user's world.
        images: [H, W, 3] uint8 by camera name; cameras without an image are ignored.
        masks: [H, W] uint8 by camera name, 1 = foreground; may be empty.
        progress: called with (stage, done, total).
        max_points: maximum number of points.
        stereo: whether to use dense stereo in textured regions.
        stereo_iterations: rounds of propagation and refinement.
        seed: seed of every random choice; the same seed gives the same points.
        limit: time limit of frame 0; if time is short, the search is coarser (``limit.shortened``).

    Returns:
        Points in the user's units; ``foreground`` is None if there are no masks.

    Raises:
        InitialPointsError: there are fewer than two images, an image does not have its camera's size, or no two cameras
            look at the same place.

    >>> from scas4d_core.captures import open_capture
    >>> capture = open_capture("samples/robot", image_scale=0.5)
    >>> frame = capture.frame(0)
    >>> cloud = initial_points(capture.rig, frame.images, frame.masks, stereo=False)
    >>> cloud.positions.shape == cloud.colours.shape, bool((cloud.foreground <= 1).all())
    (True, True)
    >>> cloud.method, cloud.coverage > 0.9
    ('agreement', True)
    """
    on_progress: OnProgress = progress or (lambda stage, done, total: None)
    labelled = collect_views(rig, images, masks)
    background = plain_background(labelled)
    views = labelled if background is None else with_silhouettes(labelled, background)
    on_progress("triangulation", 0, 1)
    limit = limit or TimeLimit(None)
    tracks = match_tracks(labelled, limit)
    first = PointSearch(
        labelled, views, tracks, background is not None, min(MIN_VIEWS, len(views)), stereo, stereo_iterations,
        max_points, rig.radius, seed, limit,
    )  # fmt: skip
    spacing = SPACING * pixel_size_at(labelled, look_at_point(labelled))
    points: InitialCloud | None = None
    ways = _search_methods(first, masked=bool(masks))
    for method, search in ways:
        points = _add_points(points, method, partial(find_agreeing_points, search, on_progress), search.views, spacing)
        if method != "pairs" and points is not None and points.coverage >= ENOUGH_COVERAGE:
            return points
    on_progress("plane", 0, 1)
    points = _add_points(points, "plane", partial(plane_points, labelled), views, spacing)
    before = next((search.views for method, search in ways if method == "backdrop"), views)
    known = triangulate(before, tracks, min_views=2, seed=seed).positions
    distances = stage_distances(before, known, rig.radius)
    confirmed = 0.0 if points is None else points.coverage
    if points is None or confirmed <= LITTLE_COVERAGE:
        points = merge_points(points, shared_volume(before, distances, seed), "volume", before, 4 * spacing)
    if before is views and not first.backdrop:  # otherwise the backdrop's colour is the background
        points = merge_points(points, surroundings(before, distances), "surroundings", before, 0.0)
        points = replace(points, stage=Stage.of(before, distances))
    return replace(points, coverage=confirmed)


def _add_points(
    found: InitialCloud | None,
    method: str,
    search: Callable[[], InitialPoints],
    views: Sequence[PosedPicture],
    spacing: float,
) -> InitialCloud | None:
    """Returns the previous points merged with those of a method; unchanged if it finds none."""
    try:
        return merge_points(found, search(), method, views, spacing)
    except InitialPointsError:
        return found


def _search_methods(first: PointSearch, masked: bool) -> list[tuple[str, PointSearch]]:
    """Returns the methods for points that cameras agree on, the most reliable first."""
    ways = [("agreement", first)]
    if not masked and not first.backdrop:
        colour = backdrop([view.image for view in first.labelled])
        if colour is not None:
            views = with_silhouettes(first.labelled, colour.astype(np.uint8))
            ways.append(("backdrop", replace(first, views=views, backdrop=True, min_views=2)))
    if first.min_views > 2:
        ways.append(("pairs", replace(first, min_views=2)))
    return ways


def merge_points(
    found: InitialCloud | None, cloud: InitialPoints, method: str, views: Sequence[PosedPicture], spacing: float
) -> InitialCloud:
    """Returns the previous points and those of a cloud that are farther than ``spacing`` (world units) from them."""
    if found is None:
        both = InitialCloud(cloud.positions, cloud.colours, cloud.foreground, method)
    else:
        new = np.asarray(cKDTree(found.positions).query(cloud.positions)[0]) > spacing
        labels = [found.foreground, None if cloud.foreground is None else cloud.foreground[new]]
        both = InitialCloud(
            np.concatenate([found.positions, cloud.positions[new]]),
            np.concatenate([found.colours, cloud.colours[new]]),
            # Silhouettes found by one method label only its points, so the combined cloud has no labels.
            None if any(label is None for label in labels) else np.concatenate(labels),  # type: ignore[arg-type]
            f"{found.method} + {method}",
        )
    return replace(both, coverage=image_coverage(views, both))


def image_coverage(views: Sequence[PosedPicture], cloud: InitialPoints) -> float:
    """Returns the share of image (or mask) cells that contain a point, median over the views.

    Args:
        views: views of the cameras. cloud: points in the same world.
    """
    shares = []
    for view in views:
        height, width = view.camera.height, view.camera.width
        edge = max(1, max(height, width) // CELLS)
        rows, columns = -(-height // edge), -(-width // edge)
        wanted = np.zeros((rows, columns), dtype=bool)
        lines, across = np.nonzero(np.ones((height, width), bool) if view.mask is None else view.mask)
        wanted[lines // edge, across // edge] = True
        column, line, _, inside = pixels_inside(view.camera, cloud.positions)
        held = np.zeros_like(wanted)
        held[line[inside] // edge, column[inside] // edge] = True
        if wanted.any():
            shares.append(float((held & wanted).sum() / wanted.sum()))
    return float(np.median(shares)) if shares else 0.0
