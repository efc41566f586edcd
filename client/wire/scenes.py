"""Scenes on the wire."""

from __future__ import annotations

from enum import StrEnum
from typing import Any

from pydantic import Field

from client.wire.base import Model
from client.wire.rigs import RigModel


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


class SceneState(StrEnum):
    """Where a scene is."""

    AWAITING = "awaiting_first_frame"
    INITIALISING = "initialising"
    READY = "ready"
    UPDATING = "updating"
    DEGRADED = "degraded"
    FAILED = "failed"


class ProgressModel(Model):
    """How far the first frame is."""

    stage: str
    done: int
    total: int
    detail: dict[str, float] = Field(default_factory=dict)


class SceneStatus(Model):
    """A scene as it is now."""

    id: str
    name: str
    state: SceneState = Field(
        description="awaiting_first_frame: nothing to do yet. initialising: frame 0 is being reconstructed. ready: "
        "idle, the last frame was committed whole. updating: a later frame is being reconstructed. degraded: the scene "
        "goes on, but its last frame lost a camera or was set aside; `error` says why. failed: it takes no more frames."
    )
    error: str | None = None
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
    created: str = Field(description="UTC, ISO 8601.")
    settings: dict[str, Any]


class SceneList(Model):
    """All scenes, oldest first."""

    scenes: list[SceneStatus]


class PointsReceipt(Model):
    """The initial points were taken."""

    points: int
    sha256: str
