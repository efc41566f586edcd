"""Outcomes of a frame, as enums: light enough for every process, with the texts that people read in one place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, TypedDict

REJECTED_TEXT = "previous state kept: "
"""The beginning of the text for a frame whose state is the one before."""


OTHER_ORDERS = "other orders"
"""Stage of a report: the time that a first update took in orders of its views that were not kept."""


class Candidate(StrEnum):
    """A state that may become Θ_t; the better one on the probe views does. The values are those on disk."""

    END = "end"
    """The end of the update."""
    PREVIOUS = "previous"
    """Θ_{t−1}, not moved."""
    WARM = "warm"
    """Θ_{t−1} moved on by the warm start alone."""


class FrameOutcome(StrEnum):
    """The outcome of a frame.

    >>> FrameOutcome.REJECTED_MISFIT.rejected, FrameOutcome.RELOCATED.degraded, FrameOutcome.UNCHANGED.learnt
    (True, True, False)
    """

    UPDATED = "updated"
    """The update went as it should."""
    UNCHANGED = "unchanged"
    """Θ_{t−1} shows the frame already; no iteration was needed, and nothing was learnt."""
    RETRIED = "retried"
    """Committed by a later attempt, with smaller steps or rigid layers: those before gave no plausible state."""
    RELOCATED = "relocated"
    """Committed after a longer search: the update as set had not met the frame."""
    ACCEPTED = "accepted"
    """Committed although it is not met: as many frames as the patience allows were held before it."""
    REJECTED_UNUSABLE = "rejected_unusable"
    """Θ_{t−1} stays: the pictures are too dark or too bright to learn from."""
    REJECTED_IMPLAUSIBLE = "rejected_implausible"
    """Θ_{t−1} stays: no attempt gave a finite, bounded and plausible state."""
    REJECTED_MISFIT = "rejected_misfit"
    """Θ_{t−1} stays: no state was found that shows the frame."""

    @property
    def rejected(self) -> bool:
        """True where the state of the frame before stays, because the frame was not believed."""
        return self in (self.REJECTED_UNUSABLE, self.REJECTED_IMPLAUSIBLE, self.REJECTED_MISFIT)

    @property
    def degraded(self) -> bool:
        """True where the state is not the frame's, or only in part."""
        return self not in (self.UPDATED, self.UNCHANGED)

    @property
    def learnt(self) -> bool:
        """True where the state was updated to the frame's pictures."""
        return not self.rejected and self is not self.UNCHANGED


class AlarmKind(StrEnum):
    """Subject of an alarm. The values are those on disk and on the wire; ``robust/alarms.py`` says when."""

    CAMERA_LEFT_OUT = "camera_left_out"
    """Nothing was learnt from the camera: no picture came, or it was not believed."""
    CAMERA_MISFIT = "camera_misfit"
    """The camera's picture fits worse than usual beside the others: moved, dirty, late."""
    CAMERA_COLOURS = "camera_colours"
    """The camera's colours are off against its own past and the other cameras: exposure, white balance."""
    CAMERA_SHARPNESS = "camera_sharpness"
    """The camera's picture is less sharp, or noisier, against its own past and the other cameras."""
    CAMERA_FROZEN = "camera_frozen"
    """The camera sends the same picture again, bit by bit, while the others go on."""
    LIGHT = "light"
    """All cameras see another light than the colours are in."""
    FRAME_REPEATED = "frame_repeated"
    """All cameras send the same pictures again, bit by bit."""
    FRAME_IN_PART = "frame_in_part"
    """The frame was committed in part, or after a longer search."""
    FRAME_REJECTED = "frame_rejected"
    """The frame was not believed, and the state of the frame before stays."""


@dataclass(frozen=True)
class Alarm:
    """Something that a person should look at; an entry of the report of a frame.

    Attributes:
        what: it is about. camera: that it is about, or None. evidence: for people, with figures.
    """

    what: AlarmKind
    camera: str | None
    evidence: str


class CameraTiming(TypedDict):
    """The moment at which a camera's pictures seem to be taken; a row of the report, as it is on disk.

    Keys:
        frames: after the others' (+) or before them (−), whose median is 0. error: of that, a standard error.
        off: whether the camera is clearly out of step.
    """

    frames: float
    error: float
    off: bool


def degraded_text(outcome: FrameOutcome, reason: str) -> str | None:
    """The sentence of a report for people; None of a frame that went as it should.

    >>> degraded_text(FrameOutcome.REJECTED_MISFIT, "the pictures are met at 12.0 dB")
    'previous state kept: the pictures are met at 12.0 dB'
    """
    if not outcome.degraded:
        return None
    return REJECTED_TEXT + reason if outcome.rejected else reason


COVERS_LITTLE = 0.25
"""Share of the pictures up to which the points of frame 0 that cameras agree on cover little: from
it on the surest ways to points are enough (``first_frame.initial_points``)."""


def cloud_warnings(cloud: Mapping[str, Any] | None) -> list[str]:
    """Sentences that say how unsure frame 0 is, for what its first points were made from; none where it is sure.

    Args:
        cloud: record of a ``FirstCloud``; None: of a frame that is not the first.

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
    """The sentence on what the time of frame 0 was too short for; none where it was enough.

    >>> time_warnings(["no stereo", "1500 of 3000 iterations"])[0][:75]
    'frame 0 had too little time: no stereo; 1500 of 3000 iterations; if its vie'
    """
    if not shortened:
        return []
    remedy = "if its views are poor, begin the reconstruction again with more static.seconds, or with points"
    return [f"frame 0 had too little time: {'; '.join(shortened)}; {remedy}"]


def grey_warnings(grey: Sequence[str]) -> list[str]:
    """The sentence on grey cameras beside colour ones; none where there are none.

    Args:
        grey: names of them.

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
    """Warnings of the report of the first frame, a sentence each.

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
    """A sentence on the cameras that are clearly out of step; none where none is.

    It is a lasting fault of a rig, and no news in each frame: the status of a scene has it for as long as it is so, in
    the same words; the figures, which change from frame to frame, are in the report.

    Args:
        timing: of the newest report; None: it has none.

    >>> in_step, late = {"frames": 0.02, "error": 0.03, "off": False}, {"frames": 0.41, "error": 0.03, "off": True}
    >>> timing_warnings({"a": late, "b": in_step})
    ["cameras are out of step: 'a' is late; check their trigger or genlock"]
    """
    off = {name: one["frames"] for name, one in sorted((timing or {}).items()) if one["off"]}
    if not off:
        return []
    cameras = ", ".join(f"{name!r} is {'late' if way > 0 else 'early'}" for name, way in off.items())
    return [f"cameras are out of step: {cameras}; check their trigger or genlock"]
