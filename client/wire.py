"""What crosses the wire, once: the service imports these models, the SDK returns them."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from scas4d_core.cameras import Camera, Rig

MAX_CAMERAS = 512
MAX_PIXELS_A_SIDE = 16_384

CameraName = Annotated[
    str,
    Field(
        pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}$",
        description="Letters, digits, dot, dash, underscore; not `time`, and not beginning with `mask.`.",
    ),
]
Row3 = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
Row4 = Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)]
Pixel = Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)]


class Model(BaseModel):
    """An unknown field is an error, so that a misspelt one is noticed."""

    model_config = ConfigDict(extra="forbid")


class CameraModel(Model):
    """A pinhole camera without distortion; OpenCV axes; pixel centres at +0.5."""

    name: CameraName
    intrinsics: Annotated[list[Row3], Field(min_length=3, max_length=3)] = Field(
        description="[[fx,0,cx],[0,fy,cy],[0,0,1]] in pixels; the upper left corner of the picture is (0, 0)."
    )
    world_to_camera: Annotated[list[Row4], Field(min_length=4, max_length=4)] = Field(
        description="X_cam = R X_world + t as [[R, t], [0, 1]], in the user's units."
    )
    width: int = Field(ge=1, le=MAX_PIXELS_A_SIDE, description="Pixels.")
    height: int = Field(ge=1, le=MAX_PIXELS_A_SIDE, description="Pixels.")

    @model_validator(mode="after")
    def _can_be(self) -> CameraModel:
        if self.name == "time" or self.name.startswith("mask."):
            raise ValueError(f"camera name {self.name!r} is the name of another field of a frame; rename the camera")
        self.camera()  # raises CameraError, a ValueError, for what cannot be a camera
        return self

    def camera(self) -> Camera:
        """The camera of the core."""
        return Camera(
            self.name, np.array(self.intrinsics), np.array(self.world_to_camera), width=self.width, height=self.height
        )

    @classmethod
    def of(cls, camera: Camera) -> CameraModel:
        """The camera as it goes over the wire."""
        return cls(
            name=camera.name,
            intrinsics=camera.intrinsics.tolist(),
            world_to_camera=camera.world_to_camera.tolist(),
            width=camera.width,
            height=camera.height,
        )


class RigModel(Model):
    """The cameras of a scene."""

    axes: Literal["opencv"] = Field(description="x right, y down, z forward. The only choice; named so nobody guesses.")
    cameras: Annotated[list[CameraModel], Field(min_length=1, max_length=MAX_CAMERAS)]

    @model_validator(mode="after")
    def _names_unique(self) -> RigModel:
        self.rig()
        return self

    def rig(self) -> Rig:
        """The rig of the core."""
        return Rig(tuple(camera.camera() for camera in self.cameras))

    @classmethod
    def of(cls, rig: Rig) -> RigModel:
        """The rig as it goes over the wire."""
        return cls(axes="opencv", cameras=[CameraModel.of(camera) for camera in rig.cameras])


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


class FrameReceipt(Model):
    """The frame was taken and will be reconstructed in its turn. The same frame again gets the same receipt."""

    scene: str
    index: int
    time: float = Field(description="Seconds.")
    identity: str = Field(description="SHA-256 over the sorted (camera, kind, SHA-256 of the file) and the time.")


class FrameState(StrEnum):
    """Where a frame is."""

    QUEUED = "queued"
    UPDATING = "updating"
    COMMITTED = "committed"
    SET_ASIDE = "set_aside"


class FrameReportModel(Model):
    """What became of a frame."""

    scene: str
    index: int
    time: float = Field(description="Seconds.")
    state: FrameState
    error: str | None = Field(default=None, description="Why the frame was set aside.")
    dropped_cameras: dict[str, str] = Field(default_factory=dict, description="Camera left out → reason.")
    iterations: int | None = None
    seconds: dict[str, float] = Field(default_factory=dict, description="By stage.")
    loss: list[float] = Field(default_factory=list)
    psnr: float | None = Field(default=None, description="dB, training views of the last iterations.")
    moving: int | None = None
    gaussians: int | None = None


class RenderKind(StrEnum):
    """What to render."""

    COLOUR = "colour"
    DEPTH = "depth"
    ALPHA = "alpha"
    PARTS = "parts"


class RenderFormat(StrEnum):
    """How the render is encoded."""

    PNG = "png"
    JPEG = "jpeg"
    NPZ = "npz"


Unit = Annotated[float, Field(ge=0, le=1)]


class RenderRequest(Model):
    """A novel view."""

    camera: CameraModel | str = Field(description="Any camera in the rig's world, or the name of one of the rig.")
    frame: int | None = Field(default=None, ge=0, description="Index of a committed frame; the last where not given.")
    kinds: Annotated[list[RenderKind], Field(min_length=1, max_length=4)] = Field(
        default_factory=lambda: [RenderKind.COLOUR],
        description="PNG and JPEG take one; npz takes several. Depth is along z in the rig's units, NaN where nothing "
        "is; as PNG it is 16 bit, 0 where nothing is, else 1…65535 from X-Depth-Near to X-Depth-Far.",
    )
    format: RenderFormat = RenderFormat.PNG
    background: tuple[Unit, Unit, Unit] | None = Field(default=None, description="RGB; the scene's where not given.")
    parts: int | None = Field(
        default=None, ge=1, le=254, description="Number of parts; chosen by the scene where not given."
    )


class TracksRequest(Model):
    """Trajectories of what exactly one of ids, pixels and points names."""

    ids: Annotated[list[int], Field(min_length=1)] | None = Field(default=None, description="Of Gaussians.")
    pixels: Annotated[list[Pixel], Field(min_length=1)] | None = Field(
        default=None, description="u v in the picture of `camera`; (0.5, 0.5) is the centre of the first pixel."
    )
    camera: CameraModel | str | None = Field(default=None, description="Where the pixels are: any, or one of the rig.")
    points: Annotated[list[Row3], Field(min_length=1)] | None = Field(
        default=None, description="x y z in the rig's world and units."
    )
    at: int | None = Field(default=None, ge=0, description="Frame of the pixels or points; the first committed.")
    first: int | None = Field(default=None, ge=0, description="First frame; the first committed.")
    last: int | None = Field(default=None, ge=0, description="Last frame, included; the last committed.")
    project: list[CameraModel | str] = Field(
        default_factory=list, max_length=64, description="Cameras to project into, with visibility."
    )
    format: Literal["json", "npz"] = "json"


class TracksModel(Model):
    """Trajectories of Q points over T frames, in the rig's world and units."""

    frames: list[int] = Field(description="[T] indices.")
    times: list[float] = Field(description="[T] seconds.")
    ids: list[int] = Field(description="[Q] the Gaussian that carries the point; −1 where the query met nothing.")
    confidence: list[float] = Field(description="[Q] 0…1.")
    positions: list[list[list[float] | None]] = Field(description="[Q][T] x y z; null where there is none.")
    visible: dict[str, list[list[bool]]] = Field(
        default_factory=dict, description="By camera asked for, [Q][T]: in the picture and nothing in front."
    )
    pixels: dict[str, list[list[list[float] | None]]] = Field(
        default_factory=dict, description="By camera asked for, [Q][T] u v; null behind the camera."
    )


class PartsModel(Model):
    """A part label for every Gaussian."""

    count: int
    ids: list[int] = Field(description="[N]")
    labels: list[int] = Field(description="[N] 0 … count−1; −1 for what stands still.")


class Health(Model):
    """The service answers."""

    status: Literal["live", "ready"]
    version: str
    scenes: int


class ProblemDetails(BaseModel):
    """RFC 9457. `field`, `value` and `remedy` are ours: what was wrong, with which value, and what to do."""

    model_config = ConfigDict(extra="allow")

    type: str = "about:blank"
    title: str
    status: int
    detail: str
    field: str | None = None
    value: str | None = None
    remedy: str | None = None


def tracks_model(
    frames: Sequence[int],
    times: Sequence[float],
    ids: NDArray[np.int64],
    confidence: NDArray[np.float64],
    positions: NDArray[Any],
    pixels: dict[str, NDArray[Any]],
    visible: dict[str, NDArray[np.bool_]],
) -> TracksModel:
    """Arrays [T, Q, …] to the lists [Q][T] of the wire; NaN becomes null."""

    def lists(array: NDArray[Any]) -> list[list[list[float] | None]]:
        finite = np.isfinite(array).all(axis=-1)
        return [
            [point.tolist() if ok else None for point, ok in zip(track, good, strict=True)]
            for track, good in zip(array.swapaxes(0, 1), finite.T, strict=True)
        ]

    return TracksModel(
        frames=list(frames),
        times=list(times),
        ids=ids.tolist(),
        confidence=confidence.tolist(),
        positions=lists(positions),
        pixels={name: lists(uv) for name, uv in pixels.items()},
        visible={name: seen.T.tolist() for name, seen in visible.items()},
    )
