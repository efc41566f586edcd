"""Frame outcomes and alarms as enums, and their texts for people; imports are light enough for every process."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, TypedDict

REJECTED_TEXT = "previous state kept: "
"""Prefix of the text for a frame that keeps the previous state."""


OTHER_ORDERS = "other orders"
"""Report stage: time that a first update spent on view orders that were discarded."""


class Candidate(StrEnum):
    """A candidate for Θ_t; the one with the smallest error on the probe views is kept. Values are stored on disk."""

    END = "end"
    """The state at the end of the update."""
    PREVIOUS = "previous"
    """Θ_{t−1}, unchanged."""
    WARM = "warm"
    """Θ_{t−1} moved by the warm start only."""


class FrameOutcome(StrEnum):
    """The outcome of a frame.

    >>> FrameOutcome.REJECTED_MISFIT.rejected, FrameOutcome.RELOCATED.degraded, FrameOutcome.UNCHANGED.learnt
    (True, True, False)
    """

    UPDATED = "updated"
    """The update succeeded."""
    UNCHANGED = "unchanged"
    """Θ_{t−1} already matches the frame; no iteration was needed and nothing was learnt."""
    RETRIED = "retried"
    """Committed by a later attempt, with smaller steps or rigid layers, because the first attempts gave no plausible
    state.
    """
    RELOCATED = "relocated"
    """Committed after a longer search, because the regular update did not match the frame."""
    ACCEPTED = "accepted"
    """Committed although it does not match the images, because `max_rejected_frames` frames were rejected before it."""
    REJECTED_UNUSABLE = "rejected_unusable"
    """Θ_{t−1} is kept: the images are too dark or too bright to learn from."""
    REJECTED_IMPLAUSIBLE = "rejected_implausible"
    """Θ_{t−1} is kept: no attempt gave a finite, bounded and plausible state."""
    REJECTED_MISFIT = "rejected_misfit"
    """Θ_{t−1} is kept: no state was found that matches the frame."""

    @property
    def rejected(self) -> bool:
        """True if the frame was rejected and the previous state is kept."""
        return self in (self.REJECTED_UNUSABLE, self.REJECTED_IMPLAUSIBLE, self.REJECTED_MISFIT)

    @property
    def degraded(self) -> bool:
        """True for every outcome except UPDATED and UNCHANGED."""
        return self not in (self.UPDATED, self.UNCHANGED)

    @property
    def learnt(self) -> bool:
        """True if the state was updated to the frame's images."""
        return not self.rejected and self is not self.UNCHANGED


class AlarmKind(StrEnum):
    """Subject of an alarm. The values are used on disk and in messages; see ``robust/alarms.py`` for the conditions."""

    CAMERA_LEFT_OUT = "camera_left_out"
    """Nothing was learnt from the camera: its image is missing or was excluded."""
    CAMERA_MISFIT = "camera_misfit"
    """The camera's image fits worse than usual, compared with the other cameras: moved, dirty or late."""
    CAMERA_COLOURS = "camera_colours"
    """The camera's colours differ from its own past and from the other cameras: exposure or white balance."""
    CAMERA_SHARPNESS = "camera_sharpness"
    """The camera's image is blurrier or noisier than its own past and the other cameras."""
    CAMERA_FROZEN = "camera_frozen"
    """The camera repeats a bit-identical image while the other cameras change."""
    LIGHT = "light"
    """All cameras see a lighting change relative to the scene's colours."""
    FRAME_REPEATED = "frame_repeated"
    """All cameras repeat bit-identical images."""
    FRAME_IN_PART = "frame_in_part"
    """The frame was committed in part, or after a longer search."""
    FRAME_REJECTED = "frame_rejected"
    """The frame was rejected, and the previous state is kept."""


@dataclass(frozen=True)
class Alarm:
    """A condition that needs a person's attention; an entry of a frame's report.

    Attributes:
        kind: subject of the alarm. camera: affected camera, or None. evidence: text for people, with figures.
    """

    kind: AlarmKind
    camera: str | None
    evidence: str


class CameraTiming(TypedDict):
    """The estimated capture time of a camera relative to the others; a row of the report on disk.

    Keys:
        frames: delay in frames after (+) or before (−) the median of the cameras, which is 0. error: its standard
            error.
        out_of_step: whether the camera is clearly out of step.
    """

    frames: float
    error: float
    out_of_step: bool


def degraded_text(outcome: FrameOutcome, reason: str) -> str | None:
    """Returns the report's sentence for people; None if the frame is not degraded.

    >>> degraded_text(FrameOutcome.REJECTED_MISFIT, "the pictures are met at 12.0 dB")
    'previous state kept: the pictures are met at 12.0 dB'
    """
    if not outcome.degraded:
        return None
    return REJECTED_TEXT + reason if outcome.rejected else reason


COVERS_LITTLE = 0.25
"""Minimum share of the images that the initial points confirmed by several cameras cover. Below it, frame 0 is partly a
guess; above it, no other methods are needed (``first_frame.initial_points``).
"""


def cloud_warnings(cloud: Mapping[str, Any] | None) -> list[str]:
    """Returns sentences on how uncertain frame 0 is because of its initial points; empty if it is certain.

    Args:
        cloud: record of a ``FirstCloud``; None for any frame but the first.

    >>> cloud_warnings({"method": "agreement", "points": 9000, "coverage": 0.9})
    []
    >>> cloud_warnings({"method": "agreement + pairs", "points": 900, "coverage": 0.12})[0][:75]
    'frame 0 is in part a guess: the points on which cameras agree cover 12 % of'
    """
    if cloud is None or cloud.get("coverage") is None:
        return []
    remedy = (
        "if its views are poor, begin the reconstruction again with points, masks, more cameras that look at the same "
        "place, or a plain backdrop"
    )
    if cloud["coverage"] == 0:
        return [f"frame 0 is a guess: no two cameras agree on any of its first points; {remedy}"]
    if cloud["coverage"] < COVERS_LITTLE:
        share = f"cover {100 * cloud['coverage']:.0f} % of the pictures"
        return [f"frame 0 is in part a guess: the points on which cameras agree {share}; {remedy}"]
    return []


def time_warnings(shortened: Sequence[str]) -> list[str]:
    """Returns a sentence on the steps that frame 0 had no time for; empty if the time was sufficient.

    >>> time_warnings(["no stereo", "1500 of 3000 iterations"])[0][:75]
    'frame 0 had too little time: no stereo; 1500 of 3000 iterations; if its vie'
    """
    if not shortened:
        return []
    remedy = "if its views are poor, begin the reconstruction again with more static.seconds, or with points"
    return [f"frame 0 had too little time: {'; '.join(shortened)}; {remedy}"]


def grey_warnings(grey: Sequence[str]) -> list[str]:
    """Returns a sentence on grayscale cameras mixed with colour cameras; empty if there are none.

    Args:
        grey: names of the grayscale cameras.

    >>> grey_warnings(["left"])[0][:41]
    'grey cameras beside colour ones: left; th'
    """
    if not grey:
        return []
    return [
        f"grey cameras beside colour ones: {', '.join(grey)}; their grey stands for all three channels, which dulls "
        "colours; hold them out (--test, or leave their pictures out) where the others are enough"
    ]


def first_warnings(record: Mapping[str, Any]) -> list[str]:
    """Returns the warnings in the report of the first frame, one sentence each.

    Args:
        record: the report as JSON, or its ``cloud``, ``calibration``, ``shortened`` and ``grey`` alone.

    >>> first_warnings({"calibration": {"warnings": ["camera 'a' is off"]}})
    ["camera 'a' is off"]
    """
    return [
        *cloud_warnings(record.get("cloud")),
        *time_warnings(record.get("shortened") or ()),
        *grey_warnings(record.get("grey") or ()),
        *(record.get("calibration") or {}).get("warnings", []),
    ]


def timing_warnings(timing: Mapping[str, CameraTiming] | None) -> list[str]:
    """Returns a sentence on the cameras that are clearly out of step; empty if there are none.

    This is a lasting fault of the rig, not news of a frame. The scene status shows it in constant words while it lasts;
    the figures, which change from frame to frame, are in the report.

    Args:
        timing: timing of the newest report; None if it has none.

    >>> in_step = {"frames": 0.02, "error": 0.03, "out_of_step": False}
    >>> late = {"frames": 0.41, "error": 0.03, "out_of_step": True}
    >>> timing_warnings({"a": late, "b": in_step})
    ["cameras are out of step: 'a' is late; check their trigger or genlock"]
    """
    off = {name: one["frames"] for name, one in sorted((timing or {}).items()) if one["out_of_step"]}
    if not off:
        return []
    cameras = ", ".join(f"{name!r} is {'late' if way > 0 else 'early'}" for name, way in off.items())
    return [f"cameras are out of step: {cameras}; check their trigger or genlock"]
