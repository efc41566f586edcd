"""All that crosses the pipes between the service and the two processes of a scene. Small; bulk goes by file."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Camera, Rig


@dataclass(frozen=True, eq=False)
class SceneSpec:
    """What both processes of a scene are started with. `settings` is the engine's own object."""

    engine: str
    folder: Path
    rig: Rig
    settings: Any

    @property
    def states(self) -> Path:
        """The folder of the committed states (`scas4d_core.history.History`)."""
        return self.folder / "states"

    @property
    def points(self) -> Path:
        """The initial cloud, where one was given."""
        return self.folder / "points.npz"


# To the worker.


@dataclass(frozen=True)
class FrameReady:
    """The pictures of a frame lie in a file (`server.frame_files`)."""

    index: int
    time: float
    file: Path


@dataclass(frozen=True)
class Stop:
    """Finish what is at work and end."""


# From the worker.


@dataclass(frozen=True)
class Started:
    """A frame is at work."""

    index: int


@dataclass(frozen=True)
class Progressed:
    """The first frame is this far."""

    stage: str
    done: int
    total: int
    detail: dict[str, float]


@dataclass(frozen=True)
class Committed:
    """The frame's state is on disk."""

    index: int
    time: float
    iterations: int
    seconds: dict[str, float]
    loss: list[float]
    psnr: float
    moving: int
    gaussians: int
    dropped: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class SetAside:
    """The frame was not committed; the state is that of the frame before. `fatal`: the scene cannot go on."""

    index: int
    reason: str
    dropped: dict[str, str] = field(default_factory=dict)
    fatal: bool = False


# To the reader.


@dataclass(frozen=True, eq=False)
class RenderQuery:
    """A view of a committed frame; `parts` is the number of parts where they are asked for and it is given."""

    camera: Camera
    frame: int
    kinds: tuple[str, ...]
    format: Literal["png", "jpeg", "npz"]
    background: tuple[float, float, float]
    parts: int | None


@dataclass(frozen=True, eq=False)
class TracksQuery:
    """Trajectories over `frames` of ids, of pixels [Q, 2] of a camera, or of points [Q, 3], the latter two at `at`.

    `project` are the cameras into which the trajectories are projected, with visibility.
    """

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

    count: int | None


@dataclass(frozen=True)
class PlyQuery:
    """A committed frame as a 3DGS .ply."""

    frame: int


Query = RenderQuery | TracksQuery | PartsQuery | PlyQuery


@dataclass(frozen=True)
class Ask:
    """A query with a number to find its answer by."""

    number: int
    query: Query


# From the reader.


@dataclass(frozen=True)
class Answer:
    """The body of an HTTP answer, encoded."""

    number: int
    body: bytes
    media_type: str
    headers: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Refused:
    """The query cannot be answered: the fault of the one who asked (`fault` False) or ours."""

    number: int
    detail: str
    fault: bool = False
