"""Wire models of frames: receipts and reports."""

from __future__ import annotations

from enum import StrEnum
from typing import Literal

from pydantic import Field

from client.wire.base import Model
from client.wire.budgets import Budget
from scas4d_core.frame_outcome import AlarmKind, FrameOutcome


class FrameReceipt(Model):
    """Confirms that a frame is on disk and queued. Repeating the same frame returns the same receipt."""

    scene: str
    index: int
    time: float = Field(description="Time of the frame in seconds.")
    identity: str = Field(description="BLAKE3 over the sorted (camera, kind, BLAKE3 of the file) and the time.")


class CameraReceipt(Model):
    """Confirms that one camera's files are on disk. Repeating the request returns it with the current cameras."""

    scene: str
    index: int
    camera: str
    received: list[str] = Field(description="Cameras whose picture has arrived, sorted.")
    absent: list[str] = Field(description="Cameras whose picture has not arrived.")
    frame: FrameReceipt | None = Field(description="Receipt of the whole frame, once it is closed.")


class FrameState(StrEnum):
    """The state of a frame. The last four states are final."""

    OPEN = "open"
    QUEUED = "queued"
    UPDATING = "updating"
    COMMITTED = "committed"
    FAILED = "failed"
    MISSING = "missing"
    SKIPPED = "skipped"


FINISHED = frozenset({FrameState.COMMITTED, FrameState.FAILED, FrameState.MISSING, FrameState.SKIPPED})
"""The final states, after which a frame no longer changes."""


class MissingRequest(Model):
    """A request to declare a frame permanently missing."""

    reason: str = Field(default="", max_length=500, description="Reason, for people.")


class CameraFitModel(Model):
    """Fit of one camera's picture to the rendering; it exposes cameras that moved or changed."""

    psnr: float | None = Field(description="PSNR in dB.")
    colour_shift: tuple[float, float, float] | None = Field(
        default=None, description="Mean of the picture minus mean of the render, RGB in 0…1; null if not measured."
    )
    health: float | None = Field(
        default=None,
        description=(
            "0…1; 1: fits as well as usual compared with the other cameras, 0: would be discarded; null if not judged."
        ),
    )


class AlarmModel(Model):
    """An alarm about a condition that requires an operator's attention."""

    kind: AlarmKind = Field(
        description=(
            "camera_left_out: the update did not use it. camera_misfit: fits worse than usual "
            "compared with the other cameras. camera_colours, camera_sharpness: differ from its past "
            "and from the other cameras. camera_frozen: sends the same picture again. light: the "
            "light has changed for all cameras. frame_repeated: all cameras send the same pictures "
            "again. frame_in_part, frame_rejected: see `degraded`."
        )
    )
    camera: str | None = Field(default=None, description="The camera; null if the alarm concerns none.")
    evidence: str = Field(description="Evidence with figures, for people.")


class CameraTimingModel(Model):
    """Time offset of a camera, estimated from the motion in all frames so far."""

    frames: float = Field(
        description=(
            "Offset in frames; positive means this camera is later than the others. The median over the cameras is 0."
        )
    )
    error: float = Field(description="Standard error of the offset, in frames.")
    out_of_step: bool = Field(description="The camera is clearly out of step; the scene's `warnings` name it.")


class CurvePointModel(Model):
    """One point of an update's loss curve."""

    iterations: int
    milliseconds: float = Field(description="Milliseconds since the update started, after decoding.")
    loss: float | None = Field(description="Mean training loss of the iterations since the previous point.")


class EffectModel(Model):
    """On/off switch of one effect."""

    on: bool = Field(description="The effect takes part in updates.")
    since: int = Field(description="Frame after which it was last switched on or off.")
    pinned: bool = Field(default=False, description="Pinned by the scene's settings; otherwise the evidence decides.")
    share: float = Field(
        default=0.0, description="0…1; what the effect explains, or would explain, according to the latest evidence."
    )
    text: str = Field(default="", description="The latest evidence, for people.")
    idle: int = Field(default=0, description="Consecutive frames with too little evidence to keep it on.")


class FirstCloudModel(Model):
    """Origin and coverage of the initial points of frame 0."""

    method: str = Field(
        description=(
            "given, or how the points were found in the pictures: agreement (of at least three "
            "cameras), backdrop (silhouettes in front of a plain backdrop), pairs (two cameras "
            "agree), plane (a floor or table on which pictures agree), surroundings (what single "
            "cameras see, far away), volume (a guess that no camera confirms: send points, or add "
            "cameras). Several methods are joined by +."
        )
    )
    points: int
    coverage: float | None = Field(
        description="0…1; share of the pictures with points on which cameras agree; null for given points."
    )


class CameraResidualModel(Model):
    """Disagreement between the features of one camera's picture and the calibration."""

    pixels: float | None = Field(
        description=(
            "Median distance of matched features from their epipolar lines, in pixels; null if too "
            "few cameras share features."
        )
    )
    matches: int = Field(description="Approximate number of correct matches.")


class RefinedCameraModel(Model):
    """A camera after refinement, compared with the given calibration."""

    rotation_deg: float = Field(description="Change of rotation, degrees.")
    translation: float = Field(description="Change of the camera's centre, in the calibration's unit.")
    focal: float = Field(description="Factor by which the focal length changed.")
    before: float | None = Field(description="Residual before refinement, pixels; null if there are too few matches.")
    after: float | None = Field(description="Residual after refinement, pixels.")
    fixed: bool = Field(description="Not refined, because there are too few matches.")
    pose: list[list[float]] = Field(description="4×4 world-to-camera matrix in the calibration's world.")


class RefinementModel(Model):
    """Result of refining a calibration."""

    accepted: bool = Field(description="The scene uses the refined rig.")
    text: str = Field(description="Outcome with figures, for people.")
    before: float | None = Field(
        description=("Typical distance of held-out matches from their epipolar lines before refinement, pixels.")
    )
    after: float | None = Field(description="The same after refinement.")
    matches: int = Field(description="Number of held-out matches.")
    cameras: dict[str, RefinedCameraModel] = Field(
        description="Refined cameras by name; empty if the refinement was not accepted."
    )


class CalibrationModel(Model):
    """Comparison of the calibration with the pictures of frame 0."""

    cameras: dict[str, CameraResidualModel] = Field(description="Residuals by camera, before refinement.")
    miscalibrated: list[str] = Field(description="Cameras that clearly disagree with their calibration.")
    warnings: list[str] = Field(description="Warnings for people, one sentence each; also in the scene's status.")
    refined: RefinementModel | None = Field(description="Null unless the setting `static.refine_calibration` is on.")


class FrameReportModel(Model):
    """Report of one frame: its state, times, errors and metrics."""

    scene: str
    index: int
    time: float | None = Field(description="Time in seconds; null for a frame declared missing.")
    state: FrameState = Field(
        description=(
            "open: cameras are still sending. queued: on disk, waiting. updating: being "
            "reconstructed. committed: its state can be read. failed: could not be reconstructed, see "
            "`error`. missing: declared missing. skipped: the queue was full, and the scene skips to "
            "the newest frame."
        )
    )
    error: str | None = Field(default=None, description="Why the frame failed, was skipped, or is missing.")
    identity: str | None = Field(default=None, description="The identity from its receipt; null if it never had one.")
    worker_deaths: int = Field(
        default=0, description="Number of times the worker died while reconstructing this frame."
    )
    pictures_kept: bool = Field(default=False, description="The frame log still has its pictures.")
    deleted: bool = Field(
        default=False, description="The frame was committed, and retention has deleted its state since."
    )
    received: list[str] | None = Field(default=None, description="While open: cameras whose picture has arrived.")
    used_cameras: list[str] = Field(default_factory=list, description="Cameras that the update used.")
    dropped_cameras: dict[str, str] = Field(
        default_factory=dict,
        description=("Dropped cameras with the reason: no file that can be decoded, or a picture that did not fit."),
    )
    outcome: FrameOutcome | None = Field(
        default=None, description="Outcome of the update; null until the frame is committed."
    )
    degraded: str | None = Field(
        default=None, description="Why the committed state does not, or only partly, show the frame; null if it does."
    )
    candidate: Literal["end", "previous", "warm"] | None = Field(
        default=None,
        description=(
            "The committed candidate: the end of the update, the previous state, or its extrapolated motion (warm)."
        ),
    )
    attempts: list[str] = Field(
        default_factory=list, description="The attempts of the update and their outcomes, in order."
    )
    grey: list[str] = Field(
        default_factory=list, description="Frame 0 only: cameras with grey pictures, if others have colour."
    )
    exposure: float | None = Field(
        default=None, description="Brightness of the frame relative to the light in which the colours are stored."
    )
    frozen_gaussians: int | None = Field(
        default=None, description="Number of Gaussians that kept their state individually."
    )
    guards: dict[str, int] = Field(default_factory=dict, description="Number of times each guard acted.")
    effects: dict[str, EffectModel] = Field(
        default_factory=dict, description="Switches of the effects after this frame, by name."
    )
    budget: Budget | None = Field(
        default=None, description="Budget of the update; null fields take the scene's settings."
    )
    iterations: int | None = None
    planned: list[tuple[int, int]] = Field(
        default_factory=list,
        description=(
            "(iteration, total iterations) for every change of the plan. A shortened frame 0 has at least two entries."
        ),
    )
    seconds: dict[str, float] = Field(default_factory=dict, description="Seconds by stage.")
    write_seconds: float | None = Field(
        default=None,
        description="Seconds to write the previous commit. The report is written before its own commit ends.",
    )
    threads: int | None = Field(default=None, description="Number of threads of the update.")
    recomputed: bool = Field(
        default=False,
        description=(
            "The state was damaged on disk and recomputed from its pictures. It shows the same, with other bits."
        ),
    )
    loss: list[float] = Field(default_factory=list)
    curve: list[CurvePointModel] = Field(default_factory=list, description="Points of the last attempt.")
    errors: dict[str, float | None] = Field(
        default_factory=dict,
        description=(
            "Mean image loss on the probe views (at most four training views) by candidate: the "
            "previous state (still), its extrapolated motion (warm), and the end of the update (end)."
        ),
    )
    psnr: float | None = Field(default=None, description="PSNR in dB on the training views of the last iterations.")
    cameras: dict[str, CameraFitModel] = Field(
        default_factory=dict, description="Fit by camera, for the cameras that the update used."
    )
    alarms: list[AlarmModel] = Field(default_factory=list, description="What needs a person's attention.")
    timing: dict[str, CameraTimingModel] = Field(
        default_factory=dict, description="Timing by camera, if the motion in the scene determines it well enough."
    )
    moving: int | None = None
    gaussians: int | None = Field(default=None, description="Number of Gaussians present, without retired ones.")
    born: int = Field(default=0, description="Gaussians added in this frame.")
    retired: int = Field(
        default=0, description="Gaussians that left the scene in this frame. Their ids are never reused."
    )
    revived: int = Field(default=0, description="Retired Gaussians that came back in this frame, with their own ids.")
    cloud: FirstCloudModel | None = Field(default=None, description="Frame 0 only: origin of its first points.")
    shortened: list[str] = Field(
        default_factory=list,
        description=(
            "Frame 0 only: stages that the time limit `static.seconds` cut by at least 5 % of their "
            "iterations. If it is empty and `planned` has one entry, frame 0 does not depend on the "
            "speed of the machine."
        ),
    )
    calibration: CalibrationModel | None = Field(
        default=None, description="Frame 0 only: its pictures compared with the calibration."
    )
    postponed: list[str] = Field(
        default_factory=list,
        description="Births for which the budget left no time. The next frame reserves time for them.",
    )


class FrameList(Model):
    """Reports of frames in index order, without losses and curves."""

    frames: list[FrameReportModel]
    next: int | None = Field(description="`first` of the next request; null if there are no more frames.")
