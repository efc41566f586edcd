"""Events in the journal of a scene.

The ledger, which contains the state of all frames, is built by applying the events in order.

The `type` tag and the fields of each event are stored in `journal.log`, so changing them requires a new format version
(`server.storage.definition.FORMAT`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from client.wire import Budget, FileKind, IngestSettings, ReconstructionRequest, Retention

Hashes = dict[str, dict[FileKind, str]]
"""BLAKE3 digest of each file, keyed by camera and kind."""


ClosedBy = Literal["whole", "complete", "request", "deadline", "found"]
"""Reason why a frame was closed.

`found` means that the journal had lost the frame and recovery found its complete record in the frame log.
"""


class _Event(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class SceneCreated(_Event):
    """Creation of the scene, with a copy of its definition in case `scene.json` is damaged."""

    type: Literal["scene_created"] = "scene_created"
    definition: dict[str, Any]


class FrameAccepted(_Event):
    """Acknowledgement of a complete frame, whose images are in the records `files` of the frame log.

    `sent` is the time that the client sent, if the frame has another one (`scas4d_core.frame_times.time_after`).
    """

    type: Literal["frame_accepted"] = "frame_accepted"
    index: int
    time: float
    sent: float | None = None
    identity: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    files: tuple[str, ...]
    closed_by: ClosedBy = "whole"


class CameraAccepted(_Event):
    """Acknowledgement of the files of one camera in an open frame; `time` is None if the camera did not send it."""

    type: Literal["camera_accepted"] = "camera_accepted"
    index: int
    time: float | None
    camera: str
    file: str
    hashes: dict[FileKind, str]


class FrameMissing(_Event):
    """Declaration by a client that a frame is missing and will not be sent."""

    type: Literal["frame_missing"] = "frame_missing"
    index: int
    reason: str


class FramesSkipped(_Event):
    """Frames skipped because frame `by` arrived while the queue was full."""

    type: Literal["frames_skipped"] = "frames_skipped"
    frames: tuple[int, ...]
    by: int


class FrameFailed(_Event):
    """Failure to reconstruct a frame; `fatal` is set if the scene cannot continue without it."""

    type: Literal["frame_failed"] = "frame_failed"
    index: int
    reason: str
    dropped: dict[str, str] = Field(default_factory=dict)
    fatal: bool = False


class WorkerDied(_Event):
    """Crash of the worker while it was processing a frame.

    `own` is true if the worker itself caused the crash, and false for an external signal.
    """

    type: Literal["worker_died"] = "worker_died"
    index: int
    reason: str
    own: bool


class PicturesDeleted(_Event):
    """Deletion of frames' images from the frame log under the retention rules."""

    type: Literal["pictures_deleted"] = "pictures_deleted"
    frames: tuple[int, ...]


class StatesDeleted(_Event):
    """Loss of committed states: deleted under the retention rules, or found damaged or missing if `reason` is set."""

    type: Literal["states_deleted"] = "states_deleted"
    frames: tuple[int, ...]
    reason: str | None = None


class StateFound(_Event):
    """Discovery of a committed state whose acknowledgement is missing from the journal; `time` is from the state."""

    type: Literal["state_found"] = "state_found"
    index: int
    time: float | None


class PauseChanged(_Event):
    """Pause or resumption of the scene."""

    type: Literal["pause_changed"] = "pause_changed"
    paused: bool


class SceneEdited(_Event):
    """Change of the scene's name, archive flag or retention rules; None leaves a field unchanged."""

    type: Literal["scene_edited"] = "scene_edited"
    name: str | None = None
    archived: bool | None = None
    keep_frames: Retention | None = None
    keep_states: Retention | None = None
    exact_states: int | None = None

    def merged_with(self, before: SceneEdited) -> SceneEdited:
        """Returns the earlier edit `before` with the changes of this edit added."""
        given = {name: getattr(self, name) for name in self.__class__.model_fields if getattr(self, name) is not None}
        return before.model_copy(update=given)

    def rules(self, ingest: IngestSettings) -> IngestSettings:
        """Returns a scene's ingest rules with this edit's retention changes applied."""
        changed: dict[str, Any] = {name: getattr(self, name) for name in ("keep_frames", "keep_states", "exact_states")}
        return ingest.model_copy(update={name: rule for name, rule in changed.items() if rule is not None})


class BudgetChanged(_Event):
    """Change of the update budget that applies to frame `index` and all later frames.

    An earlier frame that is updated again uses the budget that was set before this event.
    """

    type: Literal["budget_changed"] = "budget_changed"
    index: int
    budget: Budget


class ReconstructionBegun(_Event):
    """Restart of the reconstruction, which replaces the previous one and its states.

    Attributes:
        number: reconstruction number; the original reconstruction has 0.
        index: index of the first frame of the new reconstruction.
        points: number of the reconstruction whose initial points are used (`SceneFolder.points_of`), or None if there
            are no points.
        settings: complete settings of the scene after the restart.
        request: restart request, stored to detect repeated requests.
    """

    type: Literal["reconstruction_begun"] = "reconstruction_begun"
    number: Annotated[int, Field(ge=1)]
    index: int
    points: int | None
    settings: dict[str, Any]
    request: ReconstructionRequest


@dataclass
class OpenFrame:
    """Frame whose cameras upload separately, accumulated from its `CameraAccepted` events."""

    index: int
    time: float | None = None
    hashes: Hashes = field(default_factory=dict)
    files: list[str] = field(default_factory=list)

    @property
    def cameras(self) -> list[str]:
        """Sorted names of the cameras whose image has arrived."""
        return sorted(camera for camera, kinds in self.hashes.items() if FileKind.IMAGE in kinds)

    def add(self, part: CameraAccepted) -> None:
        """Adds the files of a camera, or another file of a known camera."""
        self.time = part.time if self.time is None else self.time
        self.hashes.setdefault(part.camera, {}).update(part.hashes)
        if part.file not in self.files:
            self.files.append(part.file)


@dataclass(slots=True)
class RareProperties:
    """Properties that only a few frames have."""

    error: str | None = None
    dropped: dict[str, str] = field(default_factory=dict)
    own_deaths: int = 0
    other_deaths: int = 0
    parts: OpenFrame | None = None
    """The single-camera uploads that formed the frame, while its images are kept."""


JournalEvent = Annotated[
    SceneCreated
    | FrameAccepted
    | CameraAccepted
    | FrameMissing
    | FramesSkipped
    | FrameFailed
    | WorkerDied
    | PicturesDeleted
    | StatesDeleted
    | StateFound
    | PauseChanged
    | SceneEdited
    | BudgetChanged
    | ReconstructionBegun,
    Field(discriminator="type"),
]
_adapter: TypeAdapter[JournalEvent] = TypeAdapter(JournalEvent)


parse_event = _adapter.validate_json
"""Parses an event from the head of a record; raises `ValidationError` if it is invalid."""


def event_fault(error: ValidationError) -> str:
    """Returns the name and the error of the first field that makes a record's head an invalid event."""
    first = error.errors()[0]
    return f"{'.'.join(map(str, first['loc'])) or 'event'}: {first['msg']}"
