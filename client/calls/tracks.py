"""Calls for trajectories of Gaussians, pixels and 3D points, and for the lifetimes of Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from client.calls.call import Call, body, json_reader, path, read_npz, wire_camera
from client.wire import GaussiansModel, TracksModel, TracksRequest
from scas4d_core.cameras import Camera


def tracks(
    id: str,
    *,
    ids: Sequence[int] | None = None,
    pixels: ArrayLike | None = None,
    camera: Camera | str | None = None,
    points: ArrayLike | None = None,
    at: int | None = None,
    frames: tuple[int, int] | None = None,
    project: Sequence[Camera | str] = (),
) -> Call[TracksModel]:
    """Returns trajectories for exactly one of `ids`, `pixels` and `points`.

    Args:
        id: scene id.
        ids: ids of the Gaussians to follow.
        pixels: [Q, 2] pixel coordinates (u, v) in the image of `camera` at frame `at`; (0.5, 0.5) is the centre of the
            first pixel.
        camera: camera that `pixels` refers to.
        points: [Q, 3] points in the rig's world frame and units, at frame `at`.
        at: frame that the pixels or points refer to; None for the first committed frame.
        frames: first and last frame, inclusive; None for all committed frames.
        project: cameras to project the trajectories into, with the visibility in each camera.

    >>> found = client.tracks(scene, ids=[0, 1], frames=(0, 1))
    >>> np.array(found.positions).shape
    (2, 2, 3)
    >>> client.tracks(scene, points=[[0, 0, 0]]).ids
    [0]
    """
    request = tracks_request(ids, pixels, camera, points, at, frames, project, "json")
    return Call("POST", path(id, "tracks", "query"), json_reader(TracksModel), arguments=body(request))


def tracks_arrays(
    id: str,
    *,
    ids: Sequence[int] | None = None,
    pixels: ArrayLike | None = None,
    camera: Camera | str | None = None,
    points: ArrayLike | None = None,
    at: int | None = None,
    frames: tuple[int, int] | None = None,
    project: Sequence[Camera | str] = (),
) -> Call[dict[str, NDArray[Any]]]:
    """Returns trajectories as arrays, which is more efficient for large queries; the arguments are those of `tracks`.

    >>> client.tracks_arrays(scene, ids=[0, 1], project=["c0"])["tracks_world"].shape
    (3, 2, 3)
    """
    request = tracks_request(ids, pixels, camera, points, at, frames, project, "npz")
    return Call("POST", path(id, "tracks", "query"), read_npz, arguments=body(request))


def gaussians(id: str, ids: Sequence[int]) -> Call[GaussiansModel]:
    """Returns the lifetime of each requested Gaussian: the frames in which it was created, retired and revived.

    >>> found = client.gaussians(scene, [1, 0])
    >>> [(one.id, one.born, one.retired) for one in found.gaussians]
    [(1, 0, []), (0, 0, [])]
    """
    arguments = {"params": {"ids": ",".join(str(int(value)) for value in ids)}}
    return Call("GET", path(id, "gaussians"), json_reader(GaussiansModel), arguments=arguments)


def tracks_request(
    ids: Sequence[int] | None,
    pixels: ArrayLike | None,
    camera: Camera | str | None,
    points: ArrayLike | None,
    at: int | None,
    frames: tuple[int | None, int | None] | None,
    project: Sequence[Camera | str],
    format: str,
) -> TracksRequest:
    """Returns the request for trajectories; the arguments are those of `tracks`."""
    first, last = frames or (None, None)
    return TracksRequest.model_validate(
        {
            "ids": None if ids is None else [int(value) for value in ids],
            "pixels": None if pixels is None else np.asarray(pixels, dtype=np.float64).tolist(),
            "camera": None if camera is None else wire_camera(camera),
            "points": None if points is None else np.asarray(points, dtype=np.float64).tolist(),
            "at": at,
            "first": first,
            "last": last,
            "project": [wire_camera(one) for one in project],
            "format": format,
        }
    )
