"""Wire models of frames: receipts and reports."""

from __future__ import annotations

from enum import StrEnum
from typing import Literal

from pydantic import Field

from client.wire.base import DisplayText, Model
from client.wire.budgets import Budget
from scas4d_core.frame_outcome import AlarmKind, FrameOutcome


class FrameReceipt(Model):
    """Confirms that a frame is on disk and queued. Sending the same frame again returns the same receipt."""

    scene: str
    index: int
    time: float
    """Time of the frame in seconds, later than the previous frame; `warnings` name another sent time."""
    identity: str
    """BLAKE3 hash of the sorted (camera, kind, file BLAKE3) entries and the time."""
    warnings: list[str] = Field(default_factory=list)
    """Sentences on a time that was not used as sent, or on times that are probably not seconds."""


class CameraReceipt(Model):
    """Confirms that one camera's files are on disk. A repeated request returns current lists."""

    scene: str
    index: int
    camera: str
    received: list[str]
    """Cameras whose image has arrived, sorted."""
    absent: list[str]
    """Cameras whose image has not arrived yet."""
    frame: FrameReceipt | None
    """Receipt for the whole frame, once it is closed."""


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
"""Final states, after which a frame no longer changes."""


class MissingRequest(Model):
    """A request to declare a frame permanently missing."""

    reason: DisplayText = Field(default="", max_length=500)
    """Human-readable reason."""


class FrameLatency(Model):
    """Latency of a committed frame in seconds, from its acknowledgement to the publication of its commit."""

    queue: float
    """From the acknowledgement until the update started."""
    update: float
    """From then until the new state was in memory, and the previous one on disk."""
    commit: float
    """From then until the state was on disk and the commit was published."""
    total: float
    """Sum of the others."""


class CameraFitModel(Model):
    """Match between a camera's image and the render; poor if the camera moved or changed."""

    psnr: float | None
    """PSNR in dB."""
    colour_shift: tuple[float, float, float] | None = None
    """Mean RGB of the image minus that of the render, for values in [0, 1]; null if not measured."""
    health: float | None = None
    """Score from 1 (fits as well as usual compared with the other cameras) to 0 (would be discarded); null if not
    evaluated.
    """


class AlarmModel(Model):
    """An alarm about a condition that needs an operator's attention."""

    kind: AlarmKind
    """camera_left_out: the update did not use the camera. camera_misfit: it fits worse than usual compared with the
    other cameras, or its lens may be dirty. camera_colours, camera_sharpness: its colours or sharpness differ from its
    own past and from the other cameras. camera_frozen: it sent the same image again. light: the lighting changed for
    all cameras. frame_repeated: all cameras sent the same images again. frame_in_part, frame_rejected: see `degraded`.
    """
    camera: str | None = None
    """Camera that the alarm concerns; null if it concerns no single camera."""
    evidence: str
    """Human-readable evidence, with figures."""


class CameraTimingModel(Model):
    """Time offset of a camera, estimated from the motion in all frames so far."""

    frames: float
    """Offset in frames; positive if this camera is later than the others. The median over all cameras is 0."""
    error: float
    """Standard error of the offset, in frames."""
    out_of_step: bool
    """Whether the camera is clearly out of step; if so, the scene's `warnings` name it."""


class CurvePointModel(Model):
    """One point on an update's loss curve."""

    iterations: int
    milliseconds: float
    """Milliseconds since the update started, excluding decoding."""
    loss: float | None
    """Mean training loss over the iterations since the previous point."""


class EffectModel(Model):
    """On/off state of one effect, with the evidence for it."""

    on: bool
    """Whether updates use the effect."""
    since: int
    """Frame after which the effect was last switched on or off."""
    pinned: bool = False
    """Whether the scene's settings fix the state; otherwise, the evidence decides."""
    share: float = 0.0
    """Fraction ([0, 1]) that the effect explains, or would explain, according to the latest evidence."""
    text: str = ""
    """Human-readable summary of the latest evidence."""
    idle: int = 0
    """Number of consecutive frames with too little evidence to keep the effect on."""


class FirstCloudModel(Model):
    """Origin and coverage of the initial points of frame 0."""

    method: str
    """given, or how the points were found in the images: agreement (at least three cameras agree), backdrop
    (silhouettes in front of a plain backdrop), pairs (two cameras agree), plane (a floor or table on which images
    agree), surroundings (distant content that only single cameras see), volume (a guess that no camera confirms: send
    points, or add cameras). Multiple methods are joined by +.
    """
    points: int
    coverage: float | None
    """Fraction ([0, 1]) of the images covered by points on which cameras agree; null for given points."""


class CameraResidualModel(Model):
    """Disagreement between the features in one camera's image and the calibration."""

    pixels: float | None
    """Median distance of matched features from their epipolar lines, in pixels; null if too few cameras share features.
    """
    matches: int
    """Approximate number of correct matches."""


class RefinedCameraModel(Model):
    """A camera after refinement, compared with the given calibration."""

    rotation_deg: float
    """Change in rotation, in degrees."""
    translation: float
    """Displacement of the camera centre, in the calibration's units."""
    focal: float
    """Factor by which the focal length changed."""
    before: float | None
    """Residual before refinement, in pixels; null if there are too few matches."""
    after: float | None
    """Residual after refinement, in pixels."""
    fixed: bool
    """Whether the camera was not refined, because there are too few matches."""
    pose: list[list[float]]
    """4×4 world-to-camera matrix in the calibration's world frame."""


class RefinementModel(Model):
    """Result of refining a calibration."""

    accepted: bool
    """Whether the scene uses the refined rig."""
    text: str
    """Human-readable outcome, with figures."""
    before: float | None
    """Typical distance of held-out matches from their epipolar lines before refinement, in pixels."""
    after: float | None
    """The same distance after refinement, in pixels."""
    matches: int
    """Number of held-out matches."""
    cameras: dict[str, RefinedCameraModel]
    """Refined cameras, keyed by name; empty if the refinement was not accepted."""


class CalibrationModel(Model):
    """Comparison of the calibration with the images of frame 0."""

    cameras: dict[str, CameraResidualModel]
    """Residuals before refinement, keyed by camera name."""
    miscalibrated: list[str]
    """Cameras that clearly disagree with their calibration."""
    warnings: list[str]
    """Human-readable warnings, one sentence each; also in the scene's status."""
    refined: RefinementModel | None
    """Result of refinement; null unless the setting `static.refine_calibration` is on."""


class PairsModel(Model):
    """Number of Gaussians blended into a pixel, counted in a sample of the pixels of at most two cameras.

    The number determines the time of an iteration.
    """

    mean: float
    percentile_99: int


class FrameReportModel(Model):
    """Report of one frame: its state, times, errors and metrics."""

    scene: str
    index: int
    time: float | None
    """Timestamp in seconds; null for a frame declared missing."""
    state: FrameState
    """open: cameras are still sending. queued: stored on disk, waiting. updating: being reconstructed. committed: its
    state can be read. failed: could not be reconstructed, see `error`. missing: declared missing. skipped: dropped in
    favour of the newest frame, because the queue was full.
    """
    error: str | None = None
    """Reason why the frame failed, was skipped, or is missing."""
    identity: str | None = None
    """Identity from the frame's receipt; null if it never had one."""
    worker_deaths: int = 0
    """Number of times the worker died while reconstructing this frame."""
    pictures_kept: bool = False
    """Whether the frame's images are still in the frame log."""
    deleted: bool = False
    """Whether the frame was committed, but its state has since been deleted by retention."""
    received: list[str] | None = None
    """While the frame is open: cameras whose image has arrived."""
    used_cameras: list[str] = Field(default_factory=list)
    """Cameras that the update used."""
    dropped_cameras: dict[str, str] = Field(default_factory=dict)
    """Reason for each dropped camera, keyed by camera name: no decodable file, or an image that did not fit."""
    outcome: FrameOutcome | None = None
    """Outcome of the update; null until the frame is committed."""
    degraded: str | None = None
    """Reason why the committed state shows the frame only partly or not at all; null if it shows all of it."""
    candidate: Literal["end", "previous", "warm"] | None = None
    """Committed candidate: the end of the update, the previous state, or its extrapolated motion (warm)."""
    attempts: list[str] = Field(default_factory=list)
    """Attempts at the update and their outcomes, in order."""
    grey: list[str] = Field(default_factory=list)
    """Frame 0 only: cameras with grayscale images, if others have colour."""
    exposure: float | None = None
    """Brightness of the frame relative to the lighting of the stored colours."""
    frozen_gaussians: int | None = None
    """Number of individual Gaussians that kept their previous state."""
    guards: dict[str, int] = Field(default_factory=dict)
    """Number of times each guard acted, keyed by guard name."""
    effects: dict[str, EffectModel] = Field(default_factory=dict)
    """State of each effect after this frame, keyed by name."""
    budget: Budget | None = None
    """Budget of the update; null fields default to the scene's settings."""
    iterations: int | None = None
    planned: list[tuple[int, int]] = Field(default_factory=list)
    """(iteration, total iterations) at each change of the plan. A shortened frame 0 has at least two entries."""
    seconds: dict[str, float] = Field(default_factory=dict)
    """Duration of each stage in seconds, keyed by stage name."""
    latency: FrameLatency | None = None
    """Latency of the frame; null for old frames, and for frames received before the scene last started or woke."""
    write_seconds: float | None = None
    """Seconds taken to write the previous commit; a report is written before its own commit ends."""
    device: Literal["cpu", "gpu"] | None = None
    """Device that computed the update."""
    threads: int | None = None
    """Number of threads used for the update."""
    recomputed: bool = False
    """Whether the state was damaged on disk and recomputed from its images; its bits may then differ."""
    loss: list[float] = Field(default_factory=list)
    curve: list[CurvePointModel] = Field(default_factory=list)
    """Loss curve of the last attempt."""
    errors: dict[str, float | None] = Field(default_factory=dict)
    """Mean image loss on the probe views (at most four training views) for each candidate: the previous state (still),
    its extrapolated motion (warm), and the end of the update (end).
    """
    psnr: float | None = None
    """PSNR on the training views of the last iterations, in dB."""
    cameras: dict[str, CameraFitModel] = Field(default_factory=dict)
    """Fit of each camera that the update used, keyed by camera name."""
    alarms: list[AlarmModel] = Field(default_factory=list)
    """Conditions that need an operator's attention."""
    timing: dict[str, CameraTimingModel] = Field(default_factory=dict)
    """Timing of each camera for which the motion determines it well enough."""
    moving: int | None = None
    gaussians: int | None = None
    """Number of Gaussians present, excluding retired ones."""
    pairs: PairsModel | None = None
    """Number of Gaussians blended into a pixel; null for a rejected frame."""
    born: int = 0
    """Number of Gaussians added in this frame."""
    retired: int = 0
    """Number of Gaussians that left the scene in this frame. Their ids are never reused."""
    revived: int = 0
    """Number of retired Gaussians that returned in this frame, under their own ids."""
    cloud: FirstCloudModel | None = None
    """Frame 0 only: origin of the initial points."""
    shortened: list[str] = Field(default_factory=list)
    """Frame 0 only: stages that the time limit `static.seconds` shortened by at least 5% of their iterations. If the
    list is empty and `planned` has one entry, the result of frame 0 does not depend on the speed of the machine.
    """
    calibration: CalibrationModel | None = None
    """Frame 0 only: comparison of its images with the calibration."""
    postponed: list[str] = Field(default_factory=list)
    """Descriptions of Gaussian births that the budget left no time for; the next frame reserves time for them."""


class FrameList(Model):
    """Frame reports in index order, without losses and curves."""

    frames: list[FrameReportModel]
    next: int | None
    """Value of `first` for the next request; null if there are no more frames."""
