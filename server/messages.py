"""Messages between the service and the processes of a scene.

Messages are small: images and states are exchanged as files.
"""

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
    """Specification of a scene that is passed to its processes at startup.

    For a worker that has an epoch, `folder` includes the epoch.
    """

    folder: SceneFolder
    rig: Rig
    settings: Settings
    minimum_cameras: int = 1
    retention: IngestSettings = field(default_factory=IngestSettings)
    frames_per_second: float | None = None
    nodes: Mapping[str, str] = field(default_factory=dict)
    """Labels that a node must have to run the scene's processes."""


# Messages to the worker.


@dataclass(frozen=True)
class ChangeRetention:
    """Request to the worker to apply new retention rules for states immediately."""

    rules: IngestSettings


@dataclass(frozen=True)
class FrameReady:
    """Notification that a frame's images are available in the frame log (`server.storage.frame_store`).

    `identity` is verified if a single record contains the whole frame. If each camera has its own record, damaged
    records are skipped. `budget` applies to this frame no matter when it is reconstructed.
    """

    index: int
    time: float
    files: tuple[str, ...]
    identity: str
    budget: Budget = field(default_factory=Budget)


@dataclass(frozen=True)
class DecodeAhead:
    """Notification of the frame that will probably be sent next, which the worker may decode in advance."""

    frame: FrameReady


@dataclass(frozen=True)
class RepairFiles:
    """Request to the worker to check damaged or missing files in the states folder and rewrite them if possible.

    `times` and `reports` cover only the frames whose data the service still has in memory.
    """

    names: tuple[str, ...]
    times: dict[int, float] = field(default_factory=dict)
    reports: dict[int, dict[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class RecomputeState:
    """Request to the worker to recompute a damaged state from its images and the committed frame `base`."""

    frame: FrameReady
    base: int


@dataclass(frozen=True)
class Stop:
    """Request to a process to finish its work and exit."""


# Messages from the worker.


@dataclass(frozen=True)
class Ready:
    """Notification that the worker is ready to accept frames.

    `indices` lists the committed frames that it found, `damaged` maps the unreadable ones to the reason, and `report`
    is the newest report. `faults` lists the reasons for commits that were rolled back, and the files that were
    restored, in one sentence each.
    """

    indices: tuple[int, ...] = ()
    damaged: dict[int, str] = field(default_factory=dict)
    report: dict[str, Any] = field(default_factory=dict)
    faults: tuple[str, ...] = ()


@dataclass(frozen=True)
class WaitsForNode:
    """Notification from the placement that the worker has not started because no machine has room for it."""

    reason: str


@dataclass(frozen=True)
class ResumeFailed:
    """Notification that the worker cannot resume from the committed states."""

    reason: str


@dataclass(frozen=True)
class WaitingForDisk:
    """Notification that a frame cannot be committed because the disk is full; the worker retries after `seconds`."""

    index: int
    reason: str
    seconds: float


@dataclass(frozen=True)
class Progressed:
    """Progress of the reconstruction of the first frame."""

    stage: str
    done: int
    total: int
    detail: dict[str, float]


@dataclass(frozen=True)
class StatesRetained:
    """Notification that new retention rules are in effect; `deleted` lists the frames whose states were deleted."""

    deleted: tuple[int, ...]


@dataclass(frozen=True)
class FrameSolved:
    """Notification that a frame's state is in memory and being written; the worker accepts the next frame.

    `FrameCommitted` follows once the state is on disk.
    """

    index: int


@dataclass(frozen=True)
class FrameCommitted:
    """Notification that the frame's state is on disk with its `report` (`History.report`).

    `deleted` lists the frames whose states retention deleted after the commit.
    """

    index: int
    report: dict[str, Any]
    deleted: tuple[int, ...] = ()


@dataclass(frozen=True)
class FrameFailedInWorker:
    """Notification that a frame was not committed; the state of the previous frame remains current.

    If `fatal` is true, the scene cannot continue.
    """

    index: int
    reason: str
    dropped: dict[str, str] = field(default_factory=dict)
    fatal: bool = False


class RepairOutcome(StrEnum):
    """Outcome of the repair of a file that was found damaged."""

    WHOLE = "whole"
    """The file is intact: it was rewritten in the meantime, or the read error was transient."""
    WRITTEN = "written"
    """The file was rewritten with identical contents."""
    REPORT_LOST = "report_lost"
    """The state was rewritten with identical contents; its report was damaged and is not in memory."""
    DAMAGED = "damaged"
    """The file is damaged, and no copy in memory is available to rewrite it."""
    GONE = "gone"
    """The file is no longer needed: retention deleted its frame, or the frame was rolled back."""
    RECOMPUTED = "recomputed"
    """The state was recomputed from images."""
    LOST = "lost"
    """The state could not be recomputed."""
    LATER = "later"
    """The state will be recomputed after the preceding state has been recomputed."""
    NO_ROOM = "no_room"
    """The disk is full; the repair will be retried."""


@dataclass(frozen=True)
class RepairResult:
    """Repair outcome of one file (`RepairFiles`) or of one state (`RecomputeState`, with its new report)."""

    name: str
    outcome: RepairOutcome
    reason: str = ""
    report: dict[str, Any] = field(default_factory=dict)


# Messages from every process that reads states.


@dataclass(frozen=True)
class DamageFound:
    """Notification of unreadable files in the states folder; `files` maps each name to the reason."""

    files: dict[str, str]


# Messages to and from the replay process; each replay has its own process.


@dataclass(frozen=True)
class ReplaySpec:
    """Specification of a replay, which repeats the updates of `frames` in memory for each entry of `iterations`.

    `base` is the committed frame that precedes them, and `first` is the scene's first frame, which every update needs.
    """

    scene: SceneSpec
    first: int
    base: int
    frames: tuple[FrameReady, ...]
    iterations: tuple[int, ...]


@dataclass(frozen=True)
class ReplayUpdated:
    """Notification that one update of a replay has finished."""


@dataclass(frozen=True)
class ReplayPoint:
    """Cost and accuracy for one iteration count (`scas4d_core.replay.ReplayResult`)."""

    iterations: int
    milliseconds: float
    error: float | None
    psnr: float | None
    frames: int


# Messages to and from the export process; each export has its own process.


@dataclass(frozen=True)
class ExportSpec:
    """Specification of an export, which writes committed frames to `file` in a format of `scas4d_core.exports`.

    `file` has its own folder.
    `first` is the scene's first frame, whose report every export needs. `ids` selects the Gaussians for the `tracks`
    format; None selects all moving Gaussians.
    """

    scene: SceneSpec
    file: Path
    format: str
    first: int
    frames: tuple[int, ...]
    ids: tuple[int, ...] | None = None


@dataclass(frozen=True)
class ExportProgressed:
    """Progress of an export: `done` frames have been written, and its folder occupies `size` bytes."""

    done: int
    size: int


# The last message of a replay or an export.


@dataclass(frozen=True)
class JobEnded:
    """Notification that a replay or export has ended; `fault` is the reason why it failed, or None."""

    fault: str | None = None
