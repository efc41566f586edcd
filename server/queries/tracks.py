"""Conversion of track requests from HTTP and live subscriptions into track queries.

docs/tracks.md describes the answers.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from client.wire import CameraModel, TracksRequest
from scas4d_core.cameras import Camera
from server.problems import Problem, count_noun
from server.processes import track_answers
from server.processes.queries import TracksQuery
from server.queries.render import MOST_PIXELS
from server.scene.scene import Scene

MOST_POINTS = 1_000_000
"""Maximum number of points times frames per query.

At this limit, a query takes about one minute of reader time, split into pieces, and 30 MB as npz.
"""
MOST_JSON_POINTS = 100_000
"""Maximum number of points times frames in a JSON answer, at about 100 bytes each; npz answers may have more."""
MOST_VIEWS = 4096
"""Maximum number of cameras times frames for visibility, one to three minutes of reader time for 20,000 Gaussians."""
LARGEST_ID = 2**63 - 1
"""Largest possible id of a Gaussian."""
FARTHEST = 1e15
"""Maximum absolute coordinate; squaring and scaling larger values would overflow."""


def tracks_query(scene: Scene, request: TracksRequest) -> TracksQuery:
    """Returns the reader query for a track request after validating it.

    Raises:
        Problem: 404, 409 or 503 if a frame cannot be read; 422 if the request is invalid.
    """
    kinds = {"ids": request.ids, "pixels": request.pixels, "points": request.points}
    asked = [(name, value) for name, value in kinds.items() if value is not None]
    if len(asked) != 1:
        given = ", ".join(name for name, _ in asked) or "none"
        raise Problem(
            422,
            f"expected exactly one of ids, pixels, points; got {given}",
            field="ids",
            value=given,
            remedy="pass exactly one of them",
        )
    frames = scene.committed_range(request.first, request.last, "from")
    field, queries = asked[0]
    if len(queries) * len(frames) > MOST_POINTS:
        raise Problem(
            422,
            f"too many tracks: {count_noun(len(queries), 'point')} over {count_noun(len(frames), 'frame')}",
            field=field,
            value=len(queries) * len(frames),
            remedy=f"request at most {MOST_POINTS} points times frames at once",
        )
    if request.format == "json" and len(queries) * len(frames) > MOST_JSON_POINTS:
        raise Problem(
            422,
            f"too many tracks for JSON: {count_noun(len(queries), 'point')} over {count_noun(len(frames), 'frame')}",
            field="format",
            value="json",
            remedy=f"use format npz, or request at most {MOST_JSON_POINTS} points times frames",
        )
    check_ids(request.ids or ())
    if request.pixels is not None and request.camera is None:
        raise Problem(
            422,
            "pixels require a camera",
            field="camera",
            value="nothing",
            remedy=f"set camera to one of {', '.join(scene.rig.names)}",
        )
    if request.points is not None and max(abs(value) for row in request.points for value in row) > FARTHEST:
        raise Problem(
            422,
            "a point has a coordinate that is too large",
            field="points",
            value=max((row for row in request.points), key=lambda row: max(map(abs, row))),
            remedy=f"use coordinates within ±{FARTHEST:g}, in the rig's units",
        )
    query = TracksQuery(
        frames=frames,
        at=scene.committed_frame(scene.committed[0] if request.at is None else request.at, "at"),
        ids=None if request.ids is None else tuple(request.ids),
        camera=None if request.camera is None else _camera(scene, request.camera),
        pixels=None if request.pixels is None else np.array(request.pixels),
        points=None if request.points is None else np.array(request.points),
        project=_check_camera_names([_camera(scene, camera) for camera in request.project]),
        format=request.format,
    )
    _check_pixels(query)
    cameras = track_answers.cameras_of(query)
    if len(cameras) * len(frames) > MOST_VIEWS:
        raise Problem(
            422,
            f"too many depth maps: {count_noun(len(cameras), 'camera')} over {count_noun(len(frames), 'frame')}",
            field="project" if request.project else "camera",
            value=len(cameras) * len(frames),
            remedy=f"request fewer cameras or frames at once: cameras × frames must be at most {MOST_VIEWS}",
        )
    return query


def _check_pixels(query: TracksQuery) -> None:
    """Raises `Problem` if a pixel is outside the image."""
    if query.camera is None or query.pixels is None:
        return
    width, height = query.camera.width, query.camera.height
    outside = np.flatnonzero(~((query.pixels >= 0) & (query.pixels < (width, height))).all(axis=1))
    if outside.size:
        value = query.pixels[outside[0]].tolist()
        raise Problem(
            422,
            f"pixel {int(outside[0])} is outside the image of camera {query.camera.name!r}",
            field="pixels",
            value=value,
            remedy=f"use 0 ≤ u < {width} and 0 ≤ v < {height}",
        )


def _check_camera_names(cameras: list[Camera]) -> tuple[Camera, ...]:
    """Returns the distinct cameras; raises `Problem` if two different cameras have the same name."""
    by_name: dict[str, Camera] = {}
    for camera in cameras:
        known = by_name.setdefault(camera.name, camera)
        if known is not camera and CameraModel.of(known) != CameraModel.of(camera):
            raise Problem(
                422,
                f"two different cameras are named {camera.name!r}",
                field="project",
                value=camera.name,
                remedy="use different names; answers are keyed by camera name",
            )
    return tuple(by_name.values())


def _camera(scene: Scene, camera: CameraModel | str) -> Camera:
    if isinstance(camera, str):
        return scene.camera(camera)
    # A pixel without a surface takes the depth of a rendered map, so the pixel limit of views applies.
    if camera.width * camera.height > MOST_PIXELS:
        size = f"{camera.width}x{camera.height}"
        raise Problem(
            422,
            f"the image size {size} of camera {camera.name!r} is too large",
            field="camera",
            value=size,
            remedy=f"use at most {MOST_PIXELS} pixels",
        )
    return camera.camera()


def check_ids(ids: Iterable[int]) -> None:
    """Raises `Problem` if an id is outside the range of Gaussian ids."""
    for id in ids:
        if not 0 <= id <= LARGEST_ID:
            remedy = "use ids from a response of the service"
            raise Problem(422, f"invalid id {id}", field="ids", value=id, remedy=remedy)
