"""Initial point cloud, computed from the images of frame 0 and the calibrated cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scas4d_core.cameras import Rig
from scas4d_core.captures.frame import InitialPoints
from scas4d_core.first_frame.image_warnings import image_warnings
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
"""Callback that receives the name of a stage, and its completed and total numbers of steps."""

MAX_POINTS = 60_000
"""Maximum number of points. If more points are found, the spacing between points is increased."""
MIN_VIEWS = 3
"""Number of cameras that must agree on a point. Two cameras can agree by chance anywhere along an
epipolar line."""
CELLS = 32
"""Number of cells along the longer side of an image, for measuring coverage."""
ENOUGH_COVERAGE = COVERS_LITTLE
"""Coverage (see ``image_coverage``) at which a cloud is sufficient and no further methods are tried.
Captures with eighteen cameras or more reach 0.99 to 1. Sparse rigs of four to seven cameras reach 0
to 0.4 with the first method alone."""
LITTLE_COVERAGE = 0.05
"""Coverage up to which unconfirmed points are added, because they are better than none."""


@dataclass(eq=False)
class InitialCloud(InitialPoints):
    """Initial points, and the methods that found the points.

    Attributes:
        method: methods used, joined by " + ": "agreement" (at least three cameras agree),
            "backdrop" (silhouettes in front of a plain backdrop), "pairs" (two cameras agree),
            "plane" (a floor or table on which images agree), "surroundings" (images placed far
            behind the scene), "volume" (unconfirmed points in the volume that the cameras share).
        coverage: median over the cameras of the fraction of image cells that contain a confirmed
            point, i.e. a point on which cameras agree.
        stage: region enclosed by the surroundings, or None if there are no surroundings.
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
    """Finds points on the surfaces that are visible in the images of one frame.

    Triangulated features bound the scene, and walls, floors and domes are fitted to the features.
    PatchMatch stereo adds textured surfaces. A stereo point is kept if at least ``MIN_VIEWS``
    cameras agree on the point and few cameras see through it. The visual hull (of the masks, or of
    silhouettes in front of a plain background) and the fitted surfaces fill the remaining gaps.

    With few, widely spaced cameras, these points may cover too little of the images. Three further
    methods are then tried in turn. The first uses silhouettes in front of a backdrop that does not
    fill the image borders. The second accepts points on which two cameras agree. The third searches
    for a plane on which images agree. If almost nothing is found, points are sampled in the volume
    that the cameras share. Unless the scene has a plain backdrop, the images themselves are finally
    placed far behind the scene.

    Args:
        rig: calibrated cameras, in any world.
        images: maps each camera name to its image, [H, W, 3] uint8. Cameras without an image are
            ignored.
        masks: maps each camera name to its mask, [H, W] uint8, 1 on the foreground. The mapping may
            be empty.
        progress: function called with (stage, done, total).
        max_points: maximum number of points.
        stereo: whether to use dense stereo in textured regions.
        stereo_iterations: number of stereo rounds of propagation and refinement.
        seed: random seed. The same seed gives the same points.
        limit: time limit of frame 0, or None for no limit. If time is short, the search is coarser,
            and ``limit.shortened`` lists the shortened steps.

    Returns:
        Points in the rig's world. ``foreground`` is None unless masks or silhouettes label all
        points.

    Raises:
        InitialPointsError: if there are fewer than two images, an image or mask does not have the
            size of its camera, or no two cameras look at the same place.

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
        try:
            volume = shared_volume(before, distances, seed)
        except InitialPointsError as error:  # what the images show precedes what may follow from it
            raise InitialPointsError("; ".join([*image_warnings(images, masks), str(error)])) from error
        points = merge_points(points, volume, "volume", before, 4 * spacing)
    # A plain backdrop needs no points, because it is rendered as the background colour.
    if before is views and not first.backdrop:
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
    """Merges a method's points into the previous points.

    If the method finds no points, the previous points are returned unchanged.
    """
    try:
        return merge_points(found, search(), method, views, spacing)
    except InitialPointsError:
        return found


def _search_methods(first: PointSearch, masked: bool) -> list[tuple[str, PointSearch]]:
    """Returns the methods that search for points on which cameras agree, most reliable first."""
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
    """Returns the previous points and all points of ``cloud`` that are not close to one of these.

    Args:
        found: previous points, or None.
        cloud: points to add.
        method: name of the method that found ``cloud``.
        views: views for measuring the coverage.
        spacing: distance from the previous points, in world units, that an added point must exceed.
    """
    if found is None:
        both = InitialCloud(cloud.positions, cloud.colours, cloud.foreground, method)
    else:
        new = np.asarray(cKDTree(found.positions).query(cloud.positions)[0]) > spacing
        labels = [found.foreground, None if cloud.foreground is None else cloud.foreground[new]]
        both = InitialCloud(
            np.concatenate([found.positions, cloud.positions[new]]),
            np.concatenate([found.colours, cloud.colours[new]]),
            # The silhouettes of one method label only the points of this method. If other points
            # have no labels, the combined cloud has none either.
            None if any(label is None for label in labels) else np.concatenate(labels),  # type: ignore[arg-type]
            f"{found.method} + {method}",
        )
    return replace(both, coverage=image_coverage(views, both))


def image_coverage(views: Sequence[PosedPicture], cloud: InitialPoints) -> float:
    """Returns the median over the views of the fraction of image (or mask) cells that contain a point.

    Args:
        views: views, with masks if available.
        cloud: points, in the same world as the cameras.
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
