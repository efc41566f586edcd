"""Outcomes of frames, alarms, and their messages for users.

This module has no heavy dependencies, so every process can import it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, TypedDict

REJECTED_TEXT = "previous state kept: "
"""Prefix of the message for a frame that keeps the previous state."""


OTHER_ORDERS = "other orders"
"""Name of the report stage that measures the time a first update spends on discarded view orders."""


class Candidate(StrEnum):
    """Candidate for the new state Θ_t of a frame.

    The candidate with the lowest error on the probe views becomes the state
    (``update.best_state``). The values are stored on disk.
    """

    END = "end"
    """The state at the end of the update."""
    PREVIOUS = "previous"
    """Θ_{t−1}, unchanged."""
    WARM = "warm"
    """Θ_{t−1}, moved only by the warm start."""


class FrameOutcome(StrEnum):
    """Outcome of the attempt to update the state to a frame.

    >>> FrameOutcome.REJECTED_MISFIT.rejected, FrameOutcome.RELOCATED.degraded, FrameOutcome.UNCHANGED.learnt
    (True, True, False)
    """

    UPDATED = "updated"
    """The update succeeded."""
    UNCHANGED = "unchanged"
    """Θ_{t−1} already matches the frame; no iteration was needed and nothing was learnt."""
    RETRIED = "retried"
    """Committed by a later attempt with smaller steps or rigid layers, because earlier attempts produced no plausible
    state."""
    RELOCATED = "relocated"
    """Committed after a longer search, because the regular update did not match the frame."""
    ACCEPTED = "accepted"
    """Committed although it does not match the images: as the last of `max_rejected_frames` misfits in a row, or
    because several cameras show the same new content."""
    REJECTED_UNUSABLE = "rejected_unusable"
    """Θ_{t−1} is kept: the images are too dark or too bright to learn from."""
    REJECTED_IMPLAUSIBLE = "rejected_implausible"
    """Θ_{t−1} is kept: no attempt produced a finite, bounded and plausible state."""
    REJECTED_MISFIT = "rejected_misfit"
    """Θ_{t−1} is kept: no state was found that matches the frame."""

    @property
    def rejected(self) -> bool:
        """Whether the frame was rejected, so that the previous state is kept."""
        return self in (self.REJECTED_UNUSABLE, self.REJECTED_IMPLAUSIBLE, self.REJECTED_MISFIT)

    @property
    def degraded(self) -> bool:
        """Whether the outcome is neither UPDATED nor UNCHANGED."""
        return self not in (self.UPDATED, self.UNCHANGED)

    @property
    def learnt(self) -> bool:
        """Whether the state was updated to fit the frame's images."""
        return not self.rejected and self is not self.UNCHANGED


class AlarmKind(StrEnum):
    """Subject of an alarm. The values are stored on disk and used in messages.

    ``robust/alarms.py`` contains the conditions for the alarms.
    """

    CAMERA_LEFT_OUT = "camera_left_out"
    """Nothing was learnt from the camera: its image is missing or was excluded."""
    CAMERA_MISFIT = "camera_misfit"
    """The camera's image, or a part of it, fits worse than usual relative to the others: the camera may have moved, be
    dirty or lag."""
    CAMERA_COLOURS = "camera_colours"
    """The camera's colours (exposure or white balance) deviate from its earlier images and from the other cameras."""
    CAMERA_SHARPNESS = "camera_sharpness"
    """The camera's image is blurrier or noisier than its earlier images and those of the other cameras."""
    CAMERA_FROZEN = "camera_frozen"
    """The camera repeats a bit-identical image while the other cameras change."""
    LIGHT = "light"
    """All cameras see a lighting change relative to the scene's colours."""
    FRAME_REPEATED = "frame_repeated"
    """All cameras repeat bit-identical images."""
    FRAME_IN_PART = "frame_in_part"
    """The frame was committed only partially, or after a longer search."""
    FRAME_REJECTED = "frame_rejected"
    """The frame was rejected, and the previous state is kept."""


@dataclass(frozen=True)
class Alarm:
    """Condition that needs a person's attention. Alarms are entries of a frame report.

    Attributes:
        kind: subject of the alarm.
        camera: affected camera, or None if the alarm does not concern a single camera.
        evidence: explanation for the user, with figures.
    """

    kind: AlarmKind
    camera: str | None
    evidence: str


class CameraTiming(TypedDict):
    """Estimated capture time of a camera relative to the other cameras, as stored in a report.

    Keys:
        frames: delay relative to the median over cameras, in frames; negative if the camera is
            early.
        error: standard error of the delay, in frames.
        out_of_step: whether the camera is clearly out of step.
    """

    frames: float
    error: float
    out_of_step: bool


def degraded_text(outcome: FrameOutcome, reason: str) -> str | None:
    """Returns the explanation of a degraded outcome for the user, or None for other outcomes.

    >>> degraded_text(FrameOutcome.REJECTED_MISFIT, "the pictures are met at 12.0 dB")
    'previous state kept: the pictures are met at 12.0 dB'
    """
    if not outcome.degraded:
        return None
    return REJECTED_TEXT + reason if outcome.rejected else reason


COVERS_LITTLE = 0.25
"""Minimum fraction of the image area covered by initial points that several cameras confirm. Below it, frame 0 is
partly a guess; above it, no other methods are needed (``first_frame.initial_points``).
"""


def cloud_warnings(cloud: Mapping[str, Any] | None) -> list[str]:
    """Returns a list with a warning if the initial points of frame 0 are unreliable.

    Args:
        cloud: fields of a ``FirstCloud``, or None for any frame except the first.

    Returns:
        The warning, or an empty list if the points are reliable or were supplied by the user.

    >>> cloud_warnings({"method": "agreement", "points": 9000, "coverage": 0.9})
    []
    >>> cloud_warnings({"method": "agreement + pairs", "points": 900, "coverage": 0.12})[0][:74]
    'frame 0 is partly a guess: the points that cameras agree on cover only 12%'
    """
    if cloud is None or cloud.get("coverage") is None:
        return []
    remedy = (
        "if its renders are poor, restart the reconstruction with points, masks, more cameras that see the same area, "
        "or a plain backdrop"
    )
    if cloud["coverage"] == 0:
        return [f"frame 0 is a guess: no two cameras agree on any initial point; {remedy}"]
    if cloud["coverage"] < COVERS_LITTLE:
        share = f"cover only {100 * cloud['coverage']:.0f}% of the images"
        return [f"frame 0 is partly a guess: the points that cameras agree on {share}; {remedy}"]
    return []


def time_warnings(shortened: Sequence[str]) -> list[str]:
    """Returns a list with a warning if steps of frame 0 were shortened for lack of time.

    Args:
        shortened: descriptions of the shortened steps; the list is empty if there are none.

    >>> time_warnings(["no stereo", "1500 of 3000 iterations"])[0][:75]
    'frame 0 did not have enough time: no stereo; 1500 of 3000 iterations; if it'
    """
    if not shortened:
        return []
    remedy = "if its renders are poor, restart the reconstruction with a larger static.seconds or with points"
    return [f"frame 0 did not have enough time: {'; '.join(shortened)}; {remedy}"]


def grey_warnings(grey: Sequence[str]) -> list[str]:
    """Returns a list with a warning if a rig of colour cameras contains grayscale cameras.

    Args:
        grey: names of the grayscale cameras; the list is empty if there are none.

    >>> grey_warnings(["left"])[0][:41]
    'grayscale cameras among colour ones: left'
    """
    if not grey:
        return []
    return [
        f"grayscale cameras among colour ones: {', '.join(grey)}; their grey values are used for all three channels, "
        "which dulls colours; if the other cameras suffice, hold these out (use --test or omit their images)"
    ]


def first_warnings(record: Mapping[str, Any]) -> list[str]:
    """Returns all warnings about the first frame, as one sentence each.

    Args:
        record: report of the first frame as JSON data. Only the entries ``cloud``, ``calibration``,
            ``shortened`` and ``grey`` are used.

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
    """Returns a list with a warning if cameras are clearly out of step with the other cameras.

    A camera that is out of step is a lasting fault of the rig, not of one frame. The text of the
    warning therefore stays the same while the fault lasts. The measured delays, which change from
    frame to frame, are in the report.

    Args:
        timing: ``timing`` entry of the newest report, or None if the report has no such entry.

    Returns:
        The warning, or an empty list if no camera is out of step.

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
