"""Scenes on the wire."""

from __future__ import annotations

from enum import StrEnum
from typing import Any, Literal

from pydantic import Field, model_validator

from client.wire.base import MAX_CAMERAS, Labels, Model
from client.wire.budgets import Budget
from client.wire.frames import EffectModel
from client.wire.rigs import RigModel
from scas4d_core.errors import InputError


class Retention(Model):
    """Retention of data that comes frame by frame: all of it, the last N frames, or the newest bytes."""

    last: int | None = Field(default=None, ge=0, description="Frames. Not together with `bytes`.")
    bytes: int | None = Field(default=None, ge=0, description="At most so many. Not together with `last`.")

    @model_validator(mode="after")
    def _one_rule(self) -> Retention:
        if self.last is not None and self.bytes is not None:
            raise InputError("last and bytes are two rules", "give one of them, or neither to keep all")
        return self


class StateBounds(Model):
    """The largest error that a state may have once it is in a compact file (docs/format.md)."""

    position: float = Field(default=0.04, ge=1e-6, le=1, description="Of a centre, in the Gaussian's own size.")
    axes: float = Field(default=0.055, ge=1e-6, le=1, description="Of its axes, in the same.")
    rotation: float = Field(default=0.05, ge=0.002, le=1, description="Of its material rotation, radians.")
    colour: float = Field(default=0.012, ge=1e-6, le=1, description="Of a channel, where colours are 0 to 1.")
    gloss: float = Field(default=0.01, ge=1e-6, le=1, description="Of a component of its gloss.")
    opacity: float = Field(default=0.0005, ge=1e-6, le=1, description="In files that are taken away; here it is exact.")


class IngestSettings(Model):
    """Rules of a scene for frames that are sent, and for what it keeps of them."""

    queue_frames: int | None = Field(
        default=None, ge=1, le=10_000, description="Frames acknowledged and not finished; the service's where null."
    )
    when_full: Literal["refuse", "skip"] = Field(
        default="refuse",
        description="refuse: 429 with Retry-After. skip: the new frame is taken, and those that wait are skipped.",
    )
    minimum_cameras: int | None = Field(
        default=None,
        ge=1,
        le=MAX_CAMERAS,
        description="A frame that has fewer pictures left fails; half of the rig's, rounded up, where null.",
    )
    part_seconds: float | None = Field(
        default=None,
        gt=0,
        le=86_400,
        description="A frame that cameras send one by one is closed so long after its first; never where null.",
    )
    keep_frames: Retention = Field(
        default=Retention(last=32), description="Pictures as they came; those not yet committed are always kept."
    )
    keep_states: Retention = Field(
        default=Retention(),
        description="Committed states; the first and the two newest are always kept. Those of a compact file, at most "
        "120, go together.",
    )
    exact_states: int | None = Field(
        default=48,
        ge=24,
        le=1_000_000,
        description="So many newest states stay exact; older ones go to compact files, within `state_bounds`, a "
        "twentieth of the size. null: all stay exact.",
    )
    state_bounds: StateBounds = StateBounds()


class SceneCreate(Model):
    """A new scene: the rig, and how to reconstruct what it sees."""

    rig: RigModel
    name: str = Field(default="", max_length=200, description="For people; the service makes the id.")
    preset: str = Field(default="scas4d", max_length=64, description="Named settings to start from.")
    settings: dict[str, Any] = Field(
        default_factory=dict, description='What differs from the preset, nested: {"update": {"iterations": 200}}.'
    )
    frames_per_second: float = Field(
        default=30.0,
        gt=0,
        le=10_000,
        description="Frame n without a time of its own is taken at n / frames_per_second.",
    )
    ingest: IngestSettings = IngestSettings()
    nodes: Labels = Field(
        default_factory=dict,
        description='On a cluster: its processes run only on nodes with all these labels, as {"rig": "stage-a"}.',
    )


class SceneEdit(Model):
    """Changes of a scene; what is left out or null stays as it is."""

    name: str | None = Field(default=None, max_length=200, description="For people.")
    archived: bool | None = Field(
        default=None,
        strict=True,
        description="true: it takes no further frames, and sleeps unless it is looked at; not while frames wait.",
    )
    keep_frames: Retention | None = Field(default=None, description="As in `ingest`; holds at once.")
    keep_states: Retention | None = Field(
        default=None, description="As in `ingest`; holds at once: states beyond it are deleted for good."
    )
    exact_states: int | None = Field(
        default=None,
        ge=24,
        le=1_000_000,
        description="As in `ingest`; older states go to compact files when the worker is idle, and stay there.",
    )

    @model_validator(mode="after")
    def _changes_something(self) -> SceneEdit:
        if all(value is None for _, value in self):
            raise InputError("nothing is to be changed", "give name, archived, keep_frames, keep_states, exact_states")
        return self


class ReconstructionRequest(Model):
    """Another beginning of a scene's reconstruction, from its first frame on, in place of the one before."""

    settings: dict[str, Any] = Field(
        default_factory=dict, description="What changes of the scene's settings, nested, as when a scene is created."
    )
    frame: int | None = Field(
        default=None,
        strict=True,
        ge=0,
        le=1_000_000_000,
        description="The frame to begin with, here or still to come; null: as before. Earlier frames fail.",
    )
    points: bool = Field(
        default=True,
        strict=True,
        description="Begin from the scene's points, the newest that were sent; false: from the pictures alone.",
    )
    discard: bool = Field(
        default=False,
        strict=True,
        description="Drop committed states; must be true where a frame after the first is committed.",
    )


class SceneState(StrEnum):
    """State of a scene."""

    AWAITING = "awaiting_first_frame"
    INITIALISING = "initialising"
    READY = "ready"
    UPDATING = "updating"
    PAUSED = "paused"
    DEGRADED = "degraded"
    FAILED = "failed"


class ProgressModel(Model):
    """Progress of the first frame."""

    stage: str
    done: int
    total: int = Field(
        description="Steps of the stage; where the time of frame 0 is short, there may come to be fewer."
    )
    detail: dict[str, float] = Field(
        default_factory=dict,
        description="Figures by name: `loss`; `seconds_left`, predicted; `seconds_at_most`, what is left of the "
        "setting `static.seconds`.",
    )


class EffectStatus(EffectModel):
    """The switch of one effect in a scene's status, with the words that describe the effect."""

    group: str = Field(description="motion, coherence, appearance, cameras or presence.")
    description: str = Field(description="A sentence that says what it does.")


class SceneStatus(Model):
    """A scene as it is now."""

    id: str
    name: str
    state: SceneState = Field(
        description="What the scene does; `paused` and `degraded` hold beside. "
        "awaiting_first_frame: nothing to do yet. initialising: frame 0 is being reconstructed. ready: "
        "idle, the last frame was committed whole. updating: a later frame is being reconstructed. paused: it takes "
        "frames and reconstructs none. degraded: the scene goes on, but its last frame lost a camera, was rejected or "
        "failed, or its worker is being restarted; `error` says why. failed: it takes no more frames until its "
        "reconstruction is begun anew (PUT …/reconstructions/{n})."
    )
    error: str | None = Field(default=None, description="Why the scene is failed or degraded.")
    progress: ProgressModel | None = Field(default=None, description="While initialising.")
    cameras: list[str]
    has_points: bool
    next_frame: int = Field(description="The only index that PUT …/frames/{n} takes next.")
    queued: int = Field(description="Frames acknowledged and not yet finished, the one at work among them.")
    queue_limit: int
    committed: int = Field(description="How many frames can be rendered and tracked.")
    first_committed: int | None
    last_committed: int | None
    gaussians: int | None
    reconstruction: int = Field(description="Number of its reconstruction: one more each time that it was begun anew.")
    first_frame: int = Field(description="The reconstruction begins with this frame; earlier frames failed.")
    paused: bool = Field(description="It begins no further frame, whatever `state` says: one may still be at work.")
    asleep: bool = Field(
        description="It was idle, has no processes and counts for nothing; it wakes by itself when it is asked or sent "
        "something. What `state` says holds.",
    )
    archived: bool = Field(description="It takes no frames until that is taken back; all it has can be looked at.")
    degraded: bool = Field(
        description="Whatever `state` says: the last frame lost a camera, was rejected, was fitted only in part or "
        "failed; the worker is being restarted, the disk is full, or damage on it was found and is being "
        "repaired. `error` says which.",
    )
    open_frames: list[int] = Field(description="Frames not closed yet, whose cameras send one by one.")
    failed: int = Field(description="Frames that were taken and could not be reconstructed.")
    missing: int = Field(description="Frames that were declared missing.")
    skipped: int = Field(description="Frames that were skipped because the queue was full.")
    worker_deaths: int = Field(description="Since the scene woke or its reconstruction began.")
    frames_kept: int = Field(description="Frames whose pictures are in the frame log.")
    frame_bytes: int = Field(description="Of the frame log on disk.")
    states_deleted: int = Field(description="Committed states that retention has deleted.")
    effects: dict[str, EffectStatus] = Field(
        description="The effects (docs/effects.md) for the next update, with their evidence."
    )
    damage: list[str] = Field(
        description="What was found damaged on disk, and what came of it, a sentence each: at the start of the service "
        "and since. The newest 100.",
    )
    warnings: list[str] = Field(
        description="What looks wrong and may be right, a sentence each: poses that seem to be the wrong way round; "
        "after frame 0, cameras that its pictures show to be off, what came of refining them, first points that "
        "no camera confirms, or that cover little of the pictures, what its time was too short for, and grey cameras "
        "beside colour ones; and cameras that motion shows to be out of step.",
    )
    created: str = Field(description="UTC, ISO 8601.")
    ingest: IngestSettings
    nodes: dict[str, str] = Field(description="On a cluster: labels of the nodes on which its processes may run.")
    settings: dict[str, Any]
    budget: Budget = Field(description="As it was put last; nulls: as `settings` say.")


class SceneList(Model):
    """All scenes, oldest first."""

    scenes: list[SceneStatus]


class PointsReceipt(Model):
    """The initial points were taken."""

    points: int
    sha256: str
    reconstruction: int = Field(description="The number of the reconstruction that begins from them.")
