"""Events of a scene's journal: the only record of its frames, from which the ledger is folded in order.

The tag of each event, `fact`, and its fields are written in `journal.log`: a change of them is another format
(`server.storage.definition.FORMAT`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from client.wire import Budget, FileKind, IngestSettings, ReconstructionRequest, Retention

Hashes = dict[str, dict[FileKind, str]]
"""BLAKE3 of each file, by camera and kind."""


class _Event(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class SceneCreated(_Event):
    """The scene was created; holds its definition again, because `scene.json` may be damaged."""

    fact: Literal["created"] = "created"
    definition: dict[str, Any]


class FrameAccepted(_Event):
    """A whole frame was acknowledged: its pictures lie in `files` of the frame log, which are all on disk."""

    fact: Literal["taken"] = "taken"
    index: int
    time: float
    identity: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    files: tuple[str, ...]
    closed_by: Literal["whole", "complete", "request", "deadline", "found"] = "whole"
    """`found`: the journal had lost the frame, and a start found its whole record in the frame log."""


class PartAccepted(_Event):
    """One camera's files of an open frame were acknowledged. `time` is None where the camera gave none."""

    fact: Literal["part"] = "part"
    index: int
    time: float | None
    camera: str
    file: str
    hashes: dict[FileKind, str]


class FrameMissing(_Event):
    """A frame was declared missing."""

    fact: Literal["missing"] = "missing"
    index: int
    reason: str


class FramesSkipped(_Event):
    """Frames were skipped because frame `by` arrived while the queue was full."""

    fact: Literal["skipped"] = "skipped"
    frames: tuple[int, ...]
    by: int


class FrameFailed(_Event):
    """A frame could not be reconstructed. `fatal`: the scene cannot go on without it."""

    fact: Literal["failed"] = "failed"
    index: int
    reason: str
    dropped: dict[str, str] = Field(default_factory=dict)
    fatal: bool = False


class WorkerDied(_Event):
    """The worker died at a frame; `own`: by a fault of its own, not by a signal from outside."""

    fact: Literal["died"] = "died"
    index: int
    reason: str
    own: bool


class PicturesDeleted(_Event):
    """Retention deleted the pictures of frames from the frame log."""

    fact: Literal["frames_deleted"] = "frames_deleted"
    frames: tuple[int, ...]


class StatesDeleted(_Event):
    """Committed states were deleted: by retention, or because they were found damaged or gone for a `reason`."""

    fact: Literal["states_deleted"] = "states_deleted"
    frames: tuple[int, ...]
    reason: str | None = None


class StateFound(_Event):
    """A committed state was found whose acknowledgement the journal has lost; `time` is that of the state."""

    fact: Literal["state_found"] = "state_found"
    index: int
    time: float | None


class PauseChanged(_Event):
    """The scene was paused or resumed."""

    fact: Literal["paused"] = "paused"
    paused: bool


class SceneEdited(_Event):
    """Name, archive or retention of the scene was changed: all that is not None. Several are as one (`after`)."""

    fact: Literal["edited"] = "edited"
    name: str | None = None
    archived: bool | None = None
    keep_frames: Retention | None = None
    keep_states: Retention | None = None
    exact_states: int | None = None

    def after(self, before: SceneEdited) -> SceneEdited:
        """Both changes in one, this one later."""
        given = {name: getattr(self, name) for name in self.__class__.model_fields if getattr(self, name) is not None}
        return before.model_copy(update=given)

    def rules(self, ingest: IngestSettings) -> IngestSettings:
        """The rules of a scene with those of retention that were changed."""
        changed: dict[str, Any] = {name: getattr(self, name) for name in ("keep_frames", "keep_states", "exact_states")}
        return ingest.model_copy(update={name: rule for name, rule in changed.items() if rule is not None})


class BudgetChanged(_Event):
    """Another budget holds from frame `index` on; a frame that is updated again gets the budget that held for it."""

    fact: Literal["budget"] = "budget"
    index: int
    budget: Budget


class ReconstructionBegun(_Event):
    """The reconstruction was begun anew, in place of the one before, whose states are read no more.

    Attributes:
        number: of the reconstruction; the one that came with the scene has 0. index: of its first frame.
        points: number of the reconstruction whose points it begins from (`SceneFolder.points_of`); None: without.
        settings: of the scene from now on, whole. asked: the request, to know it again.
    """

    fact: Literal["begun"] = "begun"
    number: Annotated[int, Field(ge=1)]
    index: int
    points: int | None
    settings: dict[str, Any]
    asked: ReconstructionRequest


@dataclass
class OpenFrame:
    """A frame whose cameras send one by one: its `PartAccepted` events, gathered."""

    index: int
    time: float | None = None
    hashes: Hashes = field(default_factory=dict)
    files: list[str] = field(default_factory=list)

    @property
    def cameras(self) -> list[str]:
        """Cameras whose picture has arrived, sorted."""
        return sorted(camera for camera, kinds in self.hashes.items() if FileKind.IMAGE in kinds)

    def add(self, part: PartAccepted) -> None:
        """Adds a camera, or another file of a camera."""
        self.time = part.time if self.time is None else self.time
        self.hashes.setdefault(part.camera, {}).update(part.hashes)
        if part.file not in self.files:
            self.files.append(part.file)


@dataclass(slots=True)
class Note:
    """Properties that few frames have."""

    error: str | None = None
    dropped: dict[str, str] = field(default_factory=dict)
    own_deaths: int = 0
    other_deaths: int = 0
    parts: OpenFrame | None = None
    """The parts that the frame was closed from, while its pictures are held."""


JournalEvent = Annotated[
    SceneCreated
    | FrameAccepted
    | PartAccepted
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
    Field(discriminator="fact"),
]
_adapter: TypeAdapter[JournalEvent] = TypeAdapter(JournalEvent)


parse_event = _adapter.validate_json
"""Reads an event from a record's head; raises `ValidationError`."""


def why_no_event(error: ValidationError) -> str:
    """Names the field of a record's head that makes it no event, and the fault."""
    first = error.errors()[0]
    return f"{'.'.join(map(str, first['loc'])) or 'event'}: {first['msg']}"
