"""Queries to the readers of a scene, and their answers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Camera


@dataclass(frozen=True, eq=False)
class RenderQuery:
    """A view of a committed frame.

    `background` None is the one that frame 0 has found. `parts` is their number where they are asked for and it is
    given; `labels` [N] are then the parts themselves.
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
    """Trajectories over `frames` of ids, of pixels [Q, 2] of a camera, or of points [Q, 3], the latter two at `at`.

    `project` are the cameras into which the trajectories are projected, with visibility.
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
    """Labels of all Gaussians."""

    kind: ClassVar[str] = "parts"
    count: int | None


@dataclass(frozen=True)
class LabelsQuery:
    """Labels of all Gaussians as little-endian int16, in the order of the states."""

    kind: ClassVar[str] = "labels"
    count: int | None


@dataclass(frozen=True)
class GaussiansQuery:
    """Lives of Gaussians by id."""

    kind: ClassVar[str] = "gaussians"
    ids: tuple[int, ...]


@dataclass(frozen=True)
class PlyQuery:
    """A committed frame as a 3DGS .ply."""

    kind: ClassVar[str] = "ply"
    frame: int


@dataclass(frozen=True)
class CompactQuery:
    """Committed frames as a compact 4D file, with the parts of all Gaussians where they are asked for."""

    kind: ClassVar[str] = "compact"
    frames: tuple[int, ...]
    parts: bool = False


Query = RenderQuery | TracksQuery | PartsQuery | LabelsQuery | GaussiansQuery | PlyQuery | CompactQuery


def refused_field(query: Query) -> tuple[str, object]:
    """Returns field and value of the part of a query that only the reader can check."""
    if isinstance(query, TracksQuery | GaussiansQuery) and query.ids is not None:
        return "ids", list(query.ids)
    if isinstance(query, TracksQuery):
        return "at", query.at
    if isinstance(query, CompactQuery):
        return "first", query.frames[0]
    if isinstance(query, LabelsQuery | PartsQuery):
        return "count", query.count if query.count is not None else "chosen by rule"
    return "frame", query.frame


@dataclass(frozen=True)
class NumberedQuery:
    """A query with a number to find its answer by.

    `stale` are frames that were committed, deleted or taken back since the query before; None: any may have been.
    """

    number: int
    query: Query
    stale: frozenset[int] | None = frozenset()


@dataclass(frozen=True)
class Answer:
    """The body of an HTTP answer, encoded."""

    number: int
    body: bytes
    media_type: str
    headers: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class QueryRefused:
    """The query cannot be answered. `status` is that of the HTTP answer; `remedy` may be empty."""

    number: int
    fault: str
    remedy: str = ""
    status: int = 422
