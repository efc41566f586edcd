"""Frames on the wire: receipts and reports."""

from __future__ import annotations

from enum import StrEnum
from typing import Literal

from pydantic import Field

from client.wire.base import Model
from client.wire.budgets import Budget
from scas4d_core.frame_outcome import AlarmKind, FrameOutcome


class FrameReceipt(Model):
    """The frame is on disk and will be reconstructed in its turn. The same frame again gets the same receipt."""

    scene: str
    index: int
    time: float = Field(description="Seconds.")
    identity: str = Field(description="BLAKE3 over the sorted (camera, kind, BLAKE3 of the file) and the time.")


class PartReceipt(Model):
    """One camera's files are on disk. The same again gets the same receipt, but for what came in since."""

    scene: str
    index: int
    camera: str
    received: list[str] = Field(description="Cameras whose picture is here, sorted.")
    absent: list[str] = Field(description="Cameras whose picture is not.")
    frame: FrameReceipt | None = Field(description="Of the whole frame, once it is closed.")


class FrameState(StrEnum):
    """State of a frame. The last four are final."""

    OPEN = "open"
    QUEUED = "queued"
    UPDATING = "updating"
    COMMITTED = "committed"
    FAILED = "failed"
    MISSING = "missing"
    SKIPPED = "skipped"


FINISHED = frozenset({FrameState.COMMITTED, FrameState.FAILED, FrameState.MISSING, FrameState.SKIPPED})
"""Nothing more happens to a frame in one of these."""


class MissingRequest(Model):
    """Declares a frame missing, for ever."""

    reason: str = Field(default="", max_length=500, description="For people.")


class CameraFitModel(Model):
    """Fit of one camera's picture when it was last rendered: a bumped or changed camera shows."""

    psnr: float | None = Field(description="dB.")
    colour_shift: tuple[float, float, float] | None = Field(
        default=None, description="Mean of the picture minus mean of the render, RGB in 0…1; null where not measured."
    )
    health: float | None = Field(
        default=None,
        description="0…1: 1 where it fits as usual beside the other cameras, 0 where it would be left out; null where "
        "not judged.",
    )


class AlarmModel(Model):
    """Something that a person should look at."""

    what: AlarmKind = Field(
        description="camera_left_out: nothing was learnt from it. camera_misfit: it fits worse than usual beside the "
        "others. camera_colours, camera_sharpness: off against its past and the others. camera_frozen: it sends the "
        "same picture again. light: all see another light. frame_repeated: all send the same pictures again. "
        "frame_in_part, frame_rejected: see `degraded`."
    )
    camera: str | None = Field(default=None, description="Null where it is about none.")
    evidence: str = Field(description="For people, with figures.")


class CameraTimingModel(Model):
    """Moment at which a camera's pictures seem to be taken, by the motion in all frames so far."""

    frames: float = Field(description="After the others' (+) or before them (-); their median is 0.")
    error: float = Field(description="Of that, a standard error.")
    off: bool = Field(description="It is clearly out of step: the scene's `warnings` name it.")


class CurvePointModel(Model):
    """One point of an update's progress."""

    iterations: int
    milliseconds: float = Field(description="Since the update began, after decoding.")
    loss: float | None = Field(description="Mean training loss of the iterations since the point before.")


class EffectModel(Model):
    """The switch of one effect."""

    on: bool = Field(description="It takes part in the updates.")
    since: int = Field(description="Frame after which it has been on, or off.")
    pinned: bool = Field(default=False, description="By the scene's settings; else the evidence decides.")
    share: float = Field(default=0.0, description="0…1, what it explains or would explain, by the last evidence.")
    text: str = Field(default="", description="The last evidence, for people.")
    idle: int = Field(default=0, description="Frames in a row with too little evidence to stay on.")


class FirstCloudModel(Model):
    """Origin of the points from which frame 0 was fitted, and how sure they are."""

    method: str = Field(
        description="given; else how the pictures gave them: agreement (of three cameras or more), backdrop "
        "(silhouettes before a plain one), pairs (two cameras agree), plane (a floor or a table on which pictures "
        "agree), surroundings (what each camera sees, far behind), volume (no camera confirms them: a guess; "
        "give points, or more cameras); several are joined by +."
    )
    points: int
    coverage: float | None = Field(
        description="0…1, share of the pictures in which there are points on which cameras agree; null where given."
    )


class CameraResidualModel(Model):
    """Distance of the features of one camera's picture from the calibration."""

    pixels: float | None = Field(
        description="Median distance of matching features from their epipolar lines, pixels of its pictures; null "
        "where too few cameras measure it."
    )
    matches: int = Field(description="Right matches, about.")


class RefinedCameraModel(Model):
    """A camera after refinement, against the calibration as it was given."""

    rotation_deg: float = Field(description="Degrees.")
    translation: float = Field(description="Of its centre, in the calibration's unit.")
    focal: float = Field(description="Times its focal length.")
    before: float | None = Field(description="Its residual as given, pixels; null where there are too few matches.")
    after: float | None = Field(description="The same, refined.")
    fixed: bool = Field(description="Left as given for want of matches.")
    pose: list[list[float]] = Field(description="4×4 world to camera, in the world of the calibration.")


class RefinementModel(Model):
    """Outcome of refining a calibration."""

    accepted: bool = Field(description="The scene has the refined rig.")
    text: str = Field(description="For people, with figures.")
    before: float | None = Field(description="Typical distance of matches held out from their epipolar lines, pixels.")
    after: float | None = Field(description="The same, refined.")
    matches: int = Field(description="Held out.")
    cameras: dict[str, RefinedCameraModel] = Field(description="By name; none where it was not accepted.")


class CalibrationModel(Model):
    """The calibration against the pictures of frame 0."""

    cameras: dict[str, CameraResidualModel] = Field(description="By name, as it was given.")
    miscalibrated: list[str] = Field(description="Cameras that are clearly off.")
    warnings: list[str] = Field(description="For people, a sentence each; they stand in the status of the scene too.")
    refined: RefinementModel | None = Field(description="Null where `static.refine_calibration` does not ask for it.")


class FrameReportModel(Model):
    """Report of one frame: its state, times, errors and metrics."""

    scene: str
    index: int
    time: float | None = Field(description="Seconds; null for a frame that was declared missing.")
    state: FrameState = Field(
        description="open: cameras are still sending. queued: on disk, waits. updating: at work. committed: its state "
        "can be read. failed: it was taken and could not be reconstructed; `error` says why. missing: it was "
        "declared missing. skipped: the queue was full and the scene skips to the newest."
    )
    error: str | None = Field(default=None, description="Why the frame failed, was skipped, or is missing.")
    identity: str | None = Field(default=None, description="As in its receipt; null where it never had one.")
    attempts: int = Field(default=0, description="How often the worker died at this frame.")
    pictures_kept: bool = Field(default=False, description="Its pictures are still in the frame log.")
    deleted: bool = Field(default=False, description="It was committed, and retention has deleted its state since.")
    received: list[str] | None = Field(default=None, description="While open: cameras whose picture is here.")
    used_cameras: list[str] = Field(default_factory=list, description="Cameras that the update saw.")
    dropped_cameras: dict[str, str] = Field(
        default_factory=dict,
        description="Camera left out → reason: it sent nothing that can be decoded, or its picture did not fit.",
    )
    outcome: FrameOutcome | None = Field(
        default=None, description="Outcome of the update; null while the frame is not committed."
    )
    degraded: str | None = Field(
        default=None, description="Why the committed state is not the frame's, or only by half; null where it is."
    )
    kept: Literal["end", "previous", "warm"] | None = Field(
        default=None,
        description="What was committed: the end of the update, the state before (still), or that going on as it moved "
        "(warm): whichever shows the frame best.",
    )
    tries: list[str] = Field(
        default_factory=list, description="In which manner the update was tried, and what came of each."
    )
    grey: list[str] = Field(
        default_factory=list, description="Of frame 0, the cameras whose pictures are grey, where others have colours."
    )
    exposure: float | None = Field(default=None, description="Times brighter than the light that the colours are in.")
    frozen_gaussians: int | None = Field(default=None, description="That stayed as they were before, one by one.")
    guards: dict[str, int] = Field(default_factory=dict, description="How often each guard acted.")
    effects: dict[str, EffectModel] = Field(
        default_factory=dict, description="Switches of the effects as this frame leaves them, by name."
    )
    budget: Budget | None = Field(default=None, description="Budget of the update; nulls: as the scene was made.")
    iterations: int | None = None
    planned: list[tuple[int, int]] = Field(
        default_factory=list,
        description="(iteration, iterations in all) whenever that was planned otherwise; "
        "of a frame 0 that was shortened, however little, two or more.",
    )
    seconds: dict[str, float] = Field(default_factory=dict, description="By stage.")
    write_seconds: float | None = Field(
        default=None, description="What writing the commit before took; its own is not known when it is written."
    )
    threads: int | None = Field(default=None, description="That the update ran on.")
    recomputed: bool = Field(
        default=False,
        description="Its state was damaged on disk and was made again from its pictures: it shows the same, and is not "
        "the same bits.",
    )
    loss: list[float] = Field(default_factory=list)
    curve: list[CurvePointModel] = Field(default_factory=list, description="Of the last attempt.")
    errors: dict[str, float | None] = Field(
        default_factory=dict,
        description="Mean image loss on at most four training views, the probe views: of the state before (still), "
        "that going on as it moved (warm), and the end of the update (end).",
    )
    psnr: float | None = Field(default=None, description="dB, training views of the last iterations.")
    cameras: dict[str, CameraFitModel] = Field(default_factory=dict, description="By camera that the update saw.")
    alarms: list[AlarmModel] = Field(default_factory=list, description="What a person should look at.")
    timing: dict[str, CameraTimingModel] = Field(
        default_factory=dict, description="By camera; only where the motion determines it well enough."
    )
    moving: int | None = None
    gaussians: int | None = Field(default=None, description="That are there; those retired are not counted.")
    born: int = Field(default=0, description="Gaussians that were born in this frame.")
    retired: int = Field(default=0, description="Gaussians that left the scene in this frame; their ids stay theirs.")
    revived: int = Field(default=0, description="Retired Gaussians that came back in this frame, as themselves.")
    cloud: FirstCloudModel | None = Field(default=None, description="Of frame 0, where its first points came from.")
    shortened: list[str] = Field(
        default_factory=list,
        description="Of frame 0: what its time (setting `static.seconds`) was too short for, of iterations from 5 % "
        "fewer on. With none, and one entry in `planned`, frame 0 does not depend on the machine.",
    )
    calibration: CalibrationModel | None = Field(
        default=None, description="Of frame 0, the calibration against its pictures."
    )
    postponed: list[str] = Field(
        default_factory=list, description="Births for which the budget left no time; the next frame has some for them."
    )


class FrameList(Model):
    """Frames in the order of their indices, without their losses and curves."""

    frames: list[FrameReportModel]
    next: int | None = Field(description="Where to go on: `first` of the next request; null where that was all.")
