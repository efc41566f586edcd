"""Encoding of trajectories, and splitting of long track queries.

A reader answers one query at a time. A long query is split into pieces, so that other queries can run in between, and
the answers are joined. docs/tracks.md describes the npz layout.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from client.wire import tracks_model
from scas4d_core.cameras import Camera
from scas4d_core.query.tapvid3d import tapvid3d
from scas4d_core.storage.history import History
from server.messages import SceneSpec
from server.processes.queries import TracksQuery

if TYPE_CHECKING:
    from scas4d_core.query.committed import CommittedScene

Arrays = dict[str, NDArray[Any]]

NPZ = "application/vnd.numpy.npz"

PIECE_QUERIES = 2048
"""Maximum number of points per piece; associating them with 25,000 Gaussians takes about 0.3 s."""
PIECE_POINTS = 32_768
"""Maximum number of points times frames per piece, about 2 s of work."""
PIECE_VIEWS = 32
"""Maximum number of frames times cameras with visibility per piece, about 1 s of work for 20,000 Gaussians."""


def npz(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Encodes arrays as npz, without pickle."""
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **arrays)
    return file.getvalue()


def metres_per_unit(spec: SceneSpec) -> float:
    """Returns the length of one scene unit in metres."""
    return spec.rig.world_frame(spec.settings.scene.metres_per_unit).metres_per_unit


def cameras_of(query: TracksQuery) -> list[Camera]:
    """Returns the distinct cameras for which pixels and visibility are computed.

    If the points are given as pixels, their camera is the first one. The cameras in `project`
    follow.
    """
    own = [query.camera] if query.pixels is not None and query.camera is not None else []
    names = [camera.name for camera in own]
    return own + [camera for camera in query.project if camera.name not in names]


def compute_tracks(reader: CommittedScene, history: History, query: TracksQuery) -> Arrays:
    """Computes trajectories: ``tracks_world`` [T, Q, 3], ``confidence`` [T, Q] and more, as in docs/tracks.md."""
    frames = list(query.frames)
    if query.ids is not None:
        tracks = reader.tracks_of_ids(np.array(query.ids, dtype=np.int64), frames)
    elif query.pixels is not None and query.camera is not None:
        tracks = reader.tracks_of_pixels(query.camera, query.pixels, query.at, frames)
    else:
        assert query.points is not None
        tracks = reader.tracks_of_points(query.points, query.at, frames)
    for camera in cameras_of(query):
        if camera.name not in tracks.visibility:
            tracks = reader.with_visibility(tracks, camera, query.at)
    return {
        "tracks_world": tracks.positions,
        "confidence": tracks.confidence,
        "ids": tracks.ids,
        "frames": np.array(frames, dtype=np.int64),
        "times": np.array([history.time(frame) for frame in frames]),
        **{f"visibility.{camera.name}": tracks.visibility[camera.name] for camera in cameras_of(query)},
    }


def encode(found: Arrays, query: TracksQuery, metres_per_unit: float) -> tuple[bytes, str]:
    """Returns the body and media type of the answer in the requested format."""
    cameras = cameras_of(query)
    pixels = {camera.name: camera.project(found["tracks_world"])[0] for camera in cameras}
    if query.format == "npz":
        arrays = found | {f"pixels.{name}": uv for name, uv in pixels.items()}
        return npz(arrays | _layout(found, query, cameras, metres_per_unit)), NPZ
    asked = [camera.name for camera in query.project]
    model = tracks_model(
        found["frames"].tolist(),
        found["times"].tolist(),
        found["ids"],
        found["confidence"],
        found["tracks_world"],
        {name: pixels[name] for name in asked},
        {name: found[f"visibility.{name}"] for name in asked},
    )
    return model.model_dump_json().encode(), "application/json"


def _layout(found: Arrays, query: TracksQuery, cameras: Sequence[Camera], metres_per_unit: float) -> Arrays:
    """Returns the TAPVid-3D arrays for the first camera.

    Without cameras, the result contains only the points in metres, in world axes.
    """
    if not cameras:
        return {"tracks_XYZ": (found["tracks_world"] * metres_per_unit).astype(np.float32)}
    row = query.frames.index(query.at) if query.at in query.frames else -1
    visible = found[f"visibility.{cameras[0].name}"]
    return tapvid3d(
        found["tracks_world"], visible, cameras[0], row, metres_per_unit=metres_per_unit, pixels=query.pixels
    )


def split_query(query: TracksQuery) -> list[list[TracksQuery]]:
    """Splits a query by points and then by frames; a short query stays whole. All pieces are answered as npz."""
    queries = next(value for value in (query.ids, query.pixels, query.points) if value is not None)
    frames = min(PIECE_POINTS // min(len(queries), PIECE_QUERIES), PIECE_VIEWS // max(1, len(cameras_of(query))))
    return [
        [
            replace(_points(query, start, stop), frames=query.frames[first:last], format="npz")
            for first, last in _cuts(len(query.frames), max(1, frames))
        ]
        for start, stop in _cuts(len(queries), PIECE_QUERIES)
    ]


def join_answers(answers: Sequence[Sequence[bytes]]) -> Arrays:
    """Joins the answers to the pieces of a query: the inner sequences along time, the outer one along points."""
    rows = [_join_in_time([_read_npz(body) for body in row]) for row in answers]
    once = ("frames", "times")
    return {
        name: rows[0][name]
        if name in once
        else np.concatenate([row[name] for row in rows], axis=0 if name == "ids" else 1)
        for name in rows[0]
    }


def join_and_encode(answers: Sequence[Sequence[bytes]], query: TracksQuery, spec: SceneSpec) -> tuple[bytes, str]:
    """Joins the answers to the pieces of a query and returns the body and media type of the whole answer."""
    return encode(join_answers(answers), query, metres_per_unit(spec))


def _join_in_time(found: Sequence[Arrays]) -> Arrays:
    return {
        name: found[0][name] if name == "ids" else np.concatenate([piece[name] for piece in found]) for name in found[0]
    }


def _read_npz(body: bytes) -> Arrays:
    """Returns the arrays made by ``compute_tracks`` from an npz answer."""
    names = ("tracks_world", "confidence", "ids", "frames", "times")
    with np.load(io.BytesIO(body), allow_pickle=False) as file:
        return {name: file[name] for name in file.files if name in names or name.startswith("visibility.")}


def _points(query: TracksQuery, start: int, stop: int) -> TracksQuery:
    return replace(
        query,
        ids=None if query.ids is None else query.ids[start:stop],
        pixels=None if query.pixels is None else query.pixels[start:stop],
        points=None if query.points is None else query.points[start:stop],
    )


def _cuts(count: int, size: int) -> list[tuple[int, int]]:
    return list(pairwise([*range(0, count, size), count]))
