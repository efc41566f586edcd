"""Queries to the reader processes of a scene, and their answers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Camera


@dataclass(frozen=True, eq=False)
class RenderQuery:
    """Query for a rendered view of a committed frame.

    If `background` is None, the background estimated in frame 0 is used. `parts` is the requested number of parts, or
    None for the automatic choice. `labels` [N] are the part labels if the view shows parts.
    """

    kind: ClassVar[str] = "render"
    camera: Camera
    frame: int
    kinds: tuple[str, ...]
    format: Literal["png", "jpeg", "webp", "npz", "float32"]
    background: tuple[float, float, float] | None
    parts: int | None = None
    quality: int | None = None
    labels: NDArray[np.int16] | None = None


@dataclass(frozen=True, eq=False)
class TracksQuery:
    """Query for trajectories over `frames`.

    The points to track are given as Gaussian ids, as pixels [Q, 2] of `camera`, or as 3D points [Q, 3]. Pixels and
    points refer to the frame `at`. `project` lists cameras into which the trajectories are projected, with visibility.
    """

    kind: ClassVar[str] = "tracks"
    frames: tuple[int, ...]
    at: int
    ids: tuple[int, ...] | None = None
    camera: Camera | None = None
    pixels: NDArray[np.float64] | None = None
    points: NDArray[np.float64] | None = None
    project: tuple[Camera, ...] = ()
    format: Literal["json", "npz"] = "json"


@dataclass(frozen=True)
class PartsQuery:
    """Query for the part labels of all Gaussians, answered as JSON."""

    kind: ClassVar[str] = "parts"
    count: int | None


@dataclass(frozen=True)
class JointsQuery:
    """Query for the joints between parts over `frames`, answered as JSON; `count` is the requested number of parts."""

    kind: ClassVar[str] = "joints"
    frames: tuple[int, ...]
    count: int | None = None


@dataclass(frozen=True)
class LabelsQuery:
    """Query for the part labels of all Gaussians as little-endian int16 values.

    The labels have the same order as the Gaussians in the committed states.
    """

    kind: ClassVar[str] = "labels"
    count: int | None


@dataclass(frozen=True)
class GaussiansQuery:
    """Query for the lifetimes of Gaussians with the given ids."""

    kind: ClassVar[str] = "gaussians"
    ids: tuple[int, ...]


@dataclass(frozen=True)
class PlyQuery:
    """Query for a committed frame as a 3DGS .ply file."""

    kind: ClassVar[str] = "ply"
    frame: int


@dataclass(frozen=True)
class CompactQuery:
    """Query for committed frames as a compact 4D file, optionally with the part labels of all Gaussians."""

    kind: ClassVar[str] = "compact"
    frames: tuple[int, ...]
    parts: bool = False


@dataclass(frozen=True)
class StatesQuery:
    """Query for the newest state as records of a compact 4D file.

    `after` is the last frame that the subscriber received from the given `encoder`; both are None at first.
    """

    kind: ClassVar[str] = "states"
    frame: int
    encoder: str | None = None
    after: int | None = None


Query = (
    RenderQuery
    | TracksQuery
    | PartsQuery
    | JointsQuery
    | LabelsQuery
    | GaussiansQuery
    | PlyQuery
    | CompactQuery
    | StatesQuery
)


def refused_field(query: Query) -> tuple[str, object]:
    """Returns the name and value of the query field that only the reader can validate."""
    if isinstance(query, TracksQuery | GaussiansQuery) and query.ids is not None:
        return "ids", list(query.ids)
    if isinstance(query, TracksQuery):
        return "at", query.at
    if isinstance(query, CompactQuery):
        return "first", query.frames[0]
    if isinstance(query, LabelsQuery | PartsQuery | JointsQuery):
        return "count", query.count if query.count is not None else "automatic"
    return "frame", query.frame


@dataclass(frozen=True)
class NumberedQuery:
    """Query with a number that identifies its answer.

    `stale` contains the frames that were committed, deleted or rolled back since the previous query, or is None if any
    frame may have changed.
    """

    number: int
    query: Query
    stale: frozenset[int] | None = frozenset()


@dataclass(frozen=True)
class Answer:
    """Answer to a query: an encoded HTTP response body with its media type and headers."""

    number: int
    body: bytes
    media_type: str
    headers: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class QueryRefused:
    """Refusal to answer a query; `status` is the HTTP status code, and `remedy` may be empty."""

    number: int
    fault: str
    remedy: str = ""
    status: int = 422
