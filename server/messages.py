"""Messages between the service and the processes of a scene. They are small: pictures and states go by file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from client.wire import Budget, IngestSettings
from scas4d_core.cameras import Rig
from scas4d_core.settings import Settings
from server.storage.layout import SceneFolder


@dataclass(frozen=True, eq=False)
class SceneSpec:
    """The scene as its processes are given it when they start; a worker's `folder` has its epoch, if it has one."""

    folder: SceneFolder
    rig: Rig
    settings: Settings
    minimum_cameras: int = 1
    kept: IngestSettings = field(default_factory=IngestSettings)
    frames_per_second: float | None = None
    nodes: Mapping[str, str] = field(default_factory=dict)
    """Labels that a node must have to run them."""


# To the worker.


@dataclass(frozen=True)
class KeepStates:
    """Other rules for states from now on."""

    rules: IngestSettings


@dataclass(frozen=True)
class FrameReady:
    """The pictures of a frame lie in records of the frame log (`server.storage.frame_store`).

    `identity` is checked where one record holds the whole frame; of several, one a camera, a damaged one is left out.
    `budget` is the one that holds for this frame, whenever it is reconstructed.
    """

    index: int
    time: float
    files: tuple[str, ...]
    identity: str
    budget: Budget = field(default_factory=Budget)


@dataclass(frozen=True)
class RepairFiles:
    """Asks the worker to check files of the states' folder, found damaged or gone, and to write them again if it can.

    `times` and `reports` of frames, as far as the service has them in memory.
    """

    names: tuple[str, ...]
    times: dict[int, float] = field(default_factory=dict)
    reports: dict[int, dict[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class RecomputeState:
    """Asks the worker to compute a damaged state again, from its pictures and the committed frame `base`."""

    frame: FrameReady
    base: int


@dataclass(frozen=True)
class Stop:
    """Asks a process to finish its work and end."""


# From the worker.


@dataclass(frozen=True)
class Ready:
    """The worker takes frames. It found `indices` committed, could not read `damaged`, and sends the newest report.

    `undone`: frames whose commit was taken back, to be given again. `faults`: why, a sentence each.
    """

    indices: tuple[int, ...] = ()
    damaged: dict[int, str] = field(default_factory=dict)
    report: dict[str, Any] = field(default_factory=dict)
    undone: tuple[int, ...] = ()
    faults: tuple[str, ...] = ()


@dataclass(frozen=True)
class WaitsForNode:
    """The worker has not started: no machine has room for it. Sent by the placement."""

    reason: str


@dataclass(frozen=True)
class Broken:
    """The worker cannot resume from the committed states."""

    reason: str


@dataclass(frozen=True)
class Stalled:
    """The frame cannot be committed for want of room on the disk; it is tried again in `seconds`."""

    index: int
    reason: str
    seconds: float


@dataclass(frozen=True)
class Progressed:
    """Progress of the first frame."""

    stage: str
    done: int
    total: int
    detail: dict[str, float]


@dataclass(frozen=True)
class StatesRetained:
    """A rule for states holds; it has deleted those of these frames."""

    deleted: tuple[int, ...]


@dataclass(frozen=True)
class FrameCommitted:
    """The frame's state is on disk, with `report` (`History.report`); retention deleted `deleted` after it."""

    index: int
    report: dict[str, Any]
    deleted: tuple[int, ...] = ()


@dataclass(frozen=True)
class UpdateFailed:
    """The frame was not committed; the state is that of the frame before. `fatal`: the scene cannot go on."""

    index: int
    reason: str
    dropped: dict[str, str] = field(default_factory=dict)
    fatal: bool = False


class RepairOutcome(StrEnum):
    """Outcomes for a file that was found damaged."""

    WHOLE = "whole"
    """It is not: it was written meanwhile, or the disk could not read it once."""
    WRITTEN = "written"
    """It was written again, the same bits."""
    REPORT_LOST = "report_lost"
    """The state was written again, the same bits; its report was damaged and is not in memory."""
    DAMAGED = "damaged"
    """It is, and nothing to write it from is in memory."""
    GONE = "gone"
    """It was deleted by the rules of the scene."""
    RECOMPUTED = "recomputed"
    """The state was made again from pictures."""
    LOST = "lost"
    """The state could not be made again."""
    LATER = "later"
    """The state is to be made again once the one before it is."""
    NO_ROOM = "no_room"
    """The disk is full; to be tried again."""


@dataclass(frozen=True)
class RepairResult:
    """The outcome for one file (`RepairFiles`) or for one state (`RecomputeState`, with its new report)."""

    name: str
    outcome: RepairOutcome
    reason: str = ""
    report: dict[str, Any] = field(default_factory=dict)


# Of every process that reads states.


@dataclass(frozen=True)
class Damaged:
    """Files of the states' folder that could not be read, by name with the reason."""

    files: dict[str, str]


# Of the replayer, which has a process for each replay.


@dataclass(frozen=True)
class ReplaySpec:
    """Frames to be updated again in memory, with each of `iterations`; `base` is the commit before them.

    `first`: the scene's first frame, which every update needs.
    """

    scene: SceneSpec
    first: int
    base: int
    frames: tuple[FrameReady, ...]
    iterations: tuple[int, ...]


@dataclass(frozen=True)
class ReplayUpdated:
    """One update of a replay is over."""


@dataclass(frozen=True)
class ReplayPoint:
    """Cost and accuracy of one number of iterations (`scas4d_core.replay.ReplayResult`)."""

    iterations: int
    milliseconds: float
    error: float | None
    psnr: float | None
    frames: int


@dataclass(frozen=True)
class ReplayEnded:
    """The replay has ended; `fault` is None if all numbers of iterations were measured."""

    fault: str | None = None


# Of the exporter, which has a process for each export.


@dataclass(frozen=True)
class ExportSpec:
    """Committed frames to be written to `file`, alone in its folder, in a format of `scas4d_core.exports`.

    `first`: the scene's first frame, whose report all need. `ids` of `tracks`, None: all that move.
    """

    scene: SceneSpec
    file: Path
    format: str
    first: int
    frames: tuple[int, ...]
    ids: tuple[int, ...] | None = None


@dataclass(frozen=True)
class ExportProgressed:
    """So many frames of an export are written; its folder has so many bytes."""

    done: int
    size: int


@dataclass(frozen=True)
class ExportEnded:
    """The export has ended; `fault` is None if its file is whole."""

    fault: str | None = None
