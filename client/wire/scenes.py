"""Wire models of scenes."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from client.wire.base import MAX_CAMERAS, MAX_NAME, DisplayText, Labels, Model
from client.wire.budgets import Budget
from client.wire.frames import EffectModel
from client.wire.rigs import RigModel
from scas4d_core.errors import InputError


class Retention(Model):
    """A retention rule for per-frame data: keep all frames, the last N frames, or the newest N bytes."""

    last: int | None = Field(default=None, ge=0)
    """Number of newest frames to keep. Cannot be combined with `bytes`."""
    bytes: int | None = Field(default=None, ge=0)
    """Maximum number of bytes to keep. Cannot be combined with `last`."""
    seconds: float | None = Field(default=None, gt=0, le=1e9)
    """Images only: maximum age in seconds since the frame was received. May be combined with `last` or `bytes`. Checked
    after each commit and once a minute while the scene is awake.
    """

    @model_validator(mode="after")
    def _one_rule(self) -> Retention:
        if self.last is not None and self.bytes is not None:
            raise InputError("last and bytes cannot be combined", "set one of them, or neither to keep all frames")
        return self


def _without_age(rule: Retention | None) -> Retention | None:
    if rule is not None and rule.seconds is not None:
        raise InputError("states have no maximum age", "set last or bytes; seconds applies to keep_frames")
    return rule


StateRetention = Annotated[Retention, AfterValidator(_without_age)]
"""Retention rule for states, which has no maximum age."""


class StateBounds(Model):
    """Error bounds of states in compact files (see docs/format.md)."""

    position: float = Field(default=0.04, ge=1e-6, le=1)
    """Maximum error of the centre, relative to the Gaussian's size."""
    axes: float = Field(default=0.055, ge=1e-6, le=1)
    """Maximum error of the axes, relative to the Gaussian's size."""
    rotation: float = Field(default=0.05, ge=0.002, le=1)
    """Maximum error of the material rotation, in radians."""
    colour: float = Field(default=0.012, ge=1e-6, le=1)
    """Maximum error per colour channel, for colours in [0, 1]."""
    gloss: float = Field(default=0.01, ge=1e-6, le=1)
    """Maximum error per gloss component."""
    opacity: float = Field(default=0.0005, ge=1e-6, le=1)
    """Maximum error of the opacity in downloaded files; stored opacities are exact."""


class IngestSettings(Model):
    """Ingest rules of a scene: queue limits, incomplete frames and retention."""

    queue_frames: int | None = Field(default=None, ge=1, le=10_000)
    """Maximum number of acknowledged but unfinished frames; null for the service's default, and at least 8 with
    `when_full` skip.
    """
    when_full: Literal["refuse", "skip"] = "refuse"
    """refuse: respond with 429 and Retry-After. skip: accept the new frame and skip the queued ones. To avoid this,
    updates run as few as a third of the iterations while frames wait, unless the scene has a budget.
    """
    minimum_cameras: int | None = Field(default=None, ge=1, le=MAX_CAMERAS)
    """Minimum number of images per frame; null for half of the rig's cameras, rounded up."""
    open_frame_seconds: float | None = Field(default=None, gt=0, le=86_400)
    """Seconds after its first image until a frame sent camera by camera is closed; null to leave it open."""
    keep_frames: Retention = Retention(last=32)
    """Retention of images. Images of frames that are not yet committed are always kept."""
    keep_states: StateRetention = Retention()
    """Retention of committed states. The first and the two newest states are always kept. The states in one compact
    file (at most 120) are deleted together.
    """
    exact_states: int | None = Field(default=48, ge=24, le=1_000_000)
    """Number of newest states to store exactly. Older states are moved to compact files, which take a twentieth of the
    space, with errors within `state_bounds`. null to store all exactly.
    """
    state_bounds: StateBounds = StateBounds()


class SceneCreate(Model):
    """A request to create a scene from a rig and settings."""

    rig: RigModel
    name: DisplayText = Field(default="", max_length=MAX_NAME)
    """Display name; the service generates the id."""
    preset: str = Field(default="scas4d", max_length=64)
    """Name of the preset that provides the default settings."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Nested settings that override the preset: {"update": {"iterations": 200}}."""
    frames_per_second: float = Field(default=30.0, ge=1e-4, le=10_000)
    """Frame rate. Frame n has the time n / frames_per_second unless it is sent with a timestamp."""
    ingest: IngestSettings = IngestSettings()
    nodes: Labels = Field(default_factory=dict)
    """On a cluster: run the scene's processes only on nodes with all these labels, such as {"rig": "stage-a"}."""


class SceneEstimate(Model):
    """Estimated memory and disk usage in MB (10⁶ bytes); `docs/operations.md` documents the formula."""

    pixels: int
    """Total number of pixels of all cameras, as sent."""
    scaled_pixels: int
    """Total number of pixels of all cameras after scaling by `settings.scene.image_scale`."""
    gaussians: int
    """Maximum number of Gaussians. If the number is chosen in frame 0, this is its upper limit."""
    pictures_mb: float
    """Worker memory for the images of one frame, proportional to cameras × pixels."""
    gaussians_mb: float
    """Memory for the Gaussians during an update."""
    worker_mb: float
    """Peak memory of the worker process."""
    readers_mb: float
    """Memory of the two reader processes, excluding queries over many frames."""
    memory_mb: float
    """Total memory of all processes of the scene."""
    gpu_mb: float
    """GPU memory of the worker and of the reader that renders views, if the scene runs on a GPU; 0 for `device: cpu`.
    """
    limit_mb: float
    """Memory limit per scene on this service."""
    state_mb: float
    """Disk space per exact state; older states take a twentieth of it."""
    history_mb: float
    """Reader memory per frame for a query over all Gaussians."""


class SceneEdit(Model):
    """Changes to a scene. Omitted and null fields stay unchanged."""

    name: DisplayText | None = Field(default=None, max_length=MAX_NAME)
    """New name."""
    archived: bool | None = Field(default=None, strict=True)
    """true to accept no more frames and sleep except when viewed. Refused while frames are queued."""
    keep_frames: Retention | None = None
    """As in `ingest`; takes effect immediately."""
    keep_states: StateRetention | None = None
    """As in `ingest`; takes effect immediately and permanently deletes the other states."""
    exact_states: int | None = Field(default=None, ge=24, le=1_000_000)
    """As in `ingest`. When idle, the worker moves older states to compact files, where they remain."""

    @model_validator(mode="after")
    def _changes_something(self) -> SceneEdit:
        if all(value is None for _, value in self):
            raise InputError(
                "the request changes nothing", "set name, archived, keep_frames, keep_states or exact_states"
            )
        return self


class ReconstructionRequest(Model):
    """A request to restart a scene's reconstruction from its first frame."""

    settings: dict[str, Any] = Field(default_factory=dict)
    """Changes to the scene's settings, nested as on creation."""
    frame: int | None = Field(default=None, strict=True, ge=0, le=1_000_000_000)
    """First frame of the new reconstruction, received or still to come; null for no change. Earlier frames fail."""
    points: bool = Field(default=True, strict=True)
    """Whether to start from the scene's newest points; false to start from the images alone."""
    discard: bool = Field(default=False, strict=True)
    """Whether to discard committed states; must be true if any frame after the first is committed."""


class SceneState(StrEnum):
    """The state of a scene."""

    AWAITING = "awaiting_first_frame"
    INITIALISING = "initialising"
    READY = "ready"
    UPDATING = "updating"
    PAUSED = "paused"
    DEGRADED = "degraded"
    FAILED = "failed"


class ProgressModel(Model):
    """Progress of frame 0."""

    stage: str
    done: int
    total: int
    """Number of steps in the stage. A short time limit for frame 0 may reduce it."""
    detail: dict[str, float] = Field(default_factory=dict)
    """Figures, keyed by name: `loss`; `seconds_left`, the predicted remaining time; `seconds_at_most`, what remains of
    the time limit `static.seconds`.
    """


class EffectStatus(EffectModel):
    """State and description of one effect in a scene's status."""

    group: str
    """Group of the effect: motion, coherence, appearance, cameras or presence."""
    description: str
    """One-sentence description of the effect."""


class SceneStatus(Model):
    """The current status of a scene."""

    id: str
    name: str
    state: SceneState
    """awaiting_first_frame: nothing to do yet. initialising: frame 0 is being reconstructed. ready: idle, and the last
    frame was fully committed. updating: a later frame is being reconstructed. paused: accepts frames but does not
    reconstruct them. degraded: continues, but the last frame lost a camera, was rejected or failed, or the worker is
    restarting; see `error`. failed: accepts no more frames until the reconstruction is restarted (PUT
    …/reconstructions/{n}). `paused` and `degraded` also have separate fields.
    """
    error: str | None = None
    """Reason why the scene failed or is degraded."""
    progress: ProgressModel | None = None
    """Progress of frame 0, while initialising."""
    cameras: list[str]
    has_points: bool
    next_frame: int
    """The only new frame index that PUT …/frames/{n} accepts."""
    queued: int
    """Number of acknowledged but unfinished frames, including the one being reconstructed."""
    queue_limit: int
    behind_seconds: float = 0.0
    """Seconds since the oldest unfinished frame was received; 0 if there is none, or if it was received before the
    scene last started or woke.
    """
    committed: int
    """Number of committed frames, which can be rendered and tracked."""
    first_committed: int | None
    last_committed: int | None
    gaussians: int | None
    reconstruction: int
    """Number of the reconstruction, increased at each restart."""
    first_frame: int
    """First frame of the reconstruction; earlier frames failed."""
    paused: bool
    """Whether the scene starts no further frames, regardless of `state`; one frame may still be running."""
    asleep: bool
    """Whether the scene is idle, has no processes and does not count towards the scene limit. Requests wake it up.
    `state` remains valid.
    """
    archived: bool
    """Whether the scene refuses frames until it is unarchived. Everything can still be viewed."""
    degraded: bool
    """Whether the last frame lost a camera, was rejected, was only partly fitted or failed, the worker is restarting,
    the disk is full, or damaged files are being repaired. `error` gives the reason. Independent of `state`.
    """
    lost_cameras: bool = False
    """Whether `degraded` is only due to cameras that the last frame lost."""
    open_frames: list[int]
    """Frames whose cameras are still sending."""
    failed: int
    """Number of frames that could not be reconstructed."""
    missing: int
    """Number of frames declared missing."""
    skipped: int
    """Number of frames skipped because the queue was full."""
    worker_deaths: int
    """Number of worker deaths since the scene woke up or its reconstruction started."""
    frames_kept: int
    """Number of frames whose images are in the frame log."""
    frames_deleted: int = 0
    """Number of acknowledged frames whose images are no longer stored."""
    frame_bytes: int
    """Size of the frame log on disk, in bytes."""
    states_deleted: int
    """Number of committed states that retention has deleted."""
    effects: dict[str, EffectStatus]
    """Effects (docs/effects.md) in the next update, with their evidence, keyed by name."""
    damage: list[str]
    """Damage found on disk and its outcome, one sentence each; only the newest 100."""
    warnings: list[str]
    """Likely mistakes, one sentence each: poses that seem inverted, cameras that disagree with their calibration, the
    outcome of refinement, initial points that no camera confirms or that cover little of the images, stages of frame 0
    that were cut short, grayscale cameras among colour cameras, and cameras that are out of step.
    """
    created: str
    """Creation time in UTC, ISO 8601."""
    ingest: IngestSettings
    nodes: dict[str, str]
    """On a cluster: labels of the nodes on which the scene's processes may run."""
    settings: dict[str, Any]
    budget: Budget
    """The most recently requested budget; null fields default to `settings`."""


class SceneList(Model):
    """All scenes, oldest first."""

    scenes: list[SceneStatus]


class PointsReceipt(Model):
    """Confirms that the initial points were accepted."""

    points: int
    sha256: str
    reconstruction: int
    """Number of the reconstruction that starts from the points."""
