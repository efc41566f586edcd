"""What the journal of a scene says: small events, for ever. Everything known of a frame follows from them in order."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from client.wire import Budget, FileKind

Hashes = dict[str, dict[FileKind, str]]
"""BLAKE3 of each file, by camera and kind."""


class _Event(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")


class SceneCreated(_Event):
    """The scene's definition, once more: `scene.json` may be damaged."""

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
    """`found`: not told by the journal, which is damaged, but whole in the frame log at a start."""


class PartAccepted(_Event):
    """One camera's files of a frame that is open were acknowledged. `time` is None where the camera gave none."""

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
    """Frames were skipped because frame `by` came and the queue was full."""

    fact: Literal["skipped"] = "skipped"
    frames: tuple[int, ...]
    by: int


class FrameSetAside(_Event):
    """A frame could not be reconstructed. `fatal`: the scene cannot go on without it."""

    fact: Literal["set_aside"] = "set_aside"
    index: int
    reason: str
    dropped: dict[str, str] = Field(default_factory=dict)
    fatal: bool = False


class WorkerDied(_Event):
    """The worker died at a frame; `own`: through its own doing, not by a signal from outside."""

    fact: Literal["died"] = "died"
    index: int
    reason: str
    own: bool


class PicturesDeleted(_Event):
    """Retention deleted the pictures of frames."""

    fact: Literal["frames_deleted"] = "frames_deleted"
    frames: tuple[int, ...]


class StatesDeleted(_Event):
    """Retention deleted committed states, or they were found damaged or gone (`reason`)."""

    fact: Literal["states_deleted"] = "states_deleted"
    frames: tuple[int, ...]
    reason: str = "retention"


class StateFound(_Event):
    """A committed state was found whose acknowledgement the journal has lost; `time` is that of the state."""

    fact: Literal["state_found"] = "state_found"
    index: int
    time: float | None


class PauseChanged(_Event):
    """The scene was paused, or told to go on."""

    fact: Literal["paused"] = "paused"
    paused: bool


class BudgetChanged(_Event):
    """Another budget holds from frame `index` on: a frame that is done again gets the one that held for it."""

    fact: Literal["budget"] = "budget"
    index: int
    budget: Budget


JournalEvent = Annotated[
    SceneCreated
    | FrameAccepted
    | PartAccepted
    | FrameMissing
    | FramesSkipped
    | FrameSetAside
    | WorkerDied
    | PicturesDeleted
    | StatesDeleted
    | StateFound
    | PauseChanged
    | BudgetChanged,
    Field(discriminator="fact"),
]
_adapter: TypeAdapter[JournalEvent] = TypeAdapter(JournalEvent)


parse_event = _adapter.validate_json
"""An event from a record's head; raises `ValidationError`."""


def why_no_event(error: ValidationError) -> str:
    """Why a head is no event."""
    first = error.errors()[0]
    return f"{'.'.join(map(str, first['loc'])) or 'event'}: {first['msg']}"
