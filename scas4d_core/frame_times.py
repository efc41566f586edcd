"""Frame times: strictly increasing times of a scene from the times that a rig sends, and warnings about the sent times.

Frames are ordered by their indices. A rig's clock may be set, or a frame may get a wrong timestamp, so sent times do
not always increase. This module requires only the standard library.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import inf, nextafter
from statistics import median_low

from scas4d_core.errors import InputError

SHORTEST_STEP, LONGEST_STEP = 1e-6, 86_400.0
"""Minimum and maximum time between two frames in seconds. A longer step is a clock that was set, not a pause."""
LATEST_FIRST = 1e10
"""Maximum magnitude of the first frame's time in seconds, the year 2286 as Unix time. Beyond it, differences of times
are inexact."""
MAX_TIME = 1e19
"""Maximum magnitude of a sent time. Unix time in nanoseconds is 1.8e18."""
ROWS = 8
"""Number of frames from which the unit of the times is judged."""
SUSPICIOUS = 100.0
"""Minimum step between frames, in multiples of the interval at the frame rate, at which the unit is suspected."""
PAUSE_FACTOR = 2.0
"""Maximum factor between the first step and a unit for which that step alone shows the unit and is not a pause."""
UNITS = {"seconds": 1.0, "milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}
"""Number of each unit in a second. A time from 1e9 to 1e10 s is probably a Unix time, from 2001 to 2286."""


@dataclass(frozen=True, slots=True)
class FrameTime:
    """Time of a frame in its scene, and the time that its sender gave, both in seconds."""

    index: int
    time: float
    sent: float


def check_time(seconds: float) -> float:
    """Returns the sent time of a frame unchanged. Times before the clock's origin, such as a trigger, are negative.

    Raises:
        InputError: if the time is not a number within ±``MAX_TIME``.
    """
    if not abs(seconds) <= MAX_TIME:
        raise time_error(seconds)
    return seconds


def time_error(value: object) -> InputError:
    """Returns the error for a value that is not the time of a frame."""
    return InputError(
        f"the time of a frame must be a number of seconds from {-MAX_TIME!r} to {MAX_TIME!r}, not {value!r}",
        "send the seconds since a fixed moment, such as 1.25, or omit time",
    )


def time_after(previous: FrameTime | None, index: int, sent: float, fps: float) -> float:
    """Returns the time of a frame in its scene, later than that of the previous frame.

    The sent time is used if it is later than the previous frame by ``SHORTEST_STEP`` to ``LONGEST_STEP``. Otherwise,
    the frame follows the previous one by the difference of their sent times or, if that is no such step either, by the
    interval at the frame rate. Thus, a timestamp that is too early or more than a day late affects one frame. A clock
    that was set, or a timestamp that is less than a day late, shifts all later times.

    Args:
        previous: the previous frame that has a time, or None.
        index: index of the frame.
        sent: time that the sender gave.
        fps: frame rate of the scene.

    >>> time_after(FrameTime(3, 0.1, 0.1), 4, 0.15, 30.0)
    0.15
    >>> time_after(FrameTime(3, 0.1, 0.1), 4, 0.0, 10.0)
    0.2
    >>> time_after(FrameTime(4, 0.2, 0.0), 5, 0.125, 10.0)
    0.325
    """
    if previous is None:
        return sent if abs(sent) <= LATEST_FIRST else index / fps
    if SHORTEST_STEP <= sent - previous.time <= LONGEST_STEP:
        return sent
    step = sent - previous.sent
    if not SHORTEST_STEP <= step <= LONGEST_STEP:
        step = (index - previous.index) / fps
    return max(previous.time + step, nextafter(previous.time, inf))


def time_warnings(frames: Sequence[FrameTime], fps: float) -> list[str]:
    """Returns sentences on times that are probably not seconds, and on a sent time that was not used.

    The unit is that in which the step between frames is closest to the interval at the frame rate, for most steps and
    for the newest one: a pause is no unit, and a sender that has corrected its unit is not warned again. A single
    frame is judged by its size.

    Args:
        frames: up to ``ROWS`` frames in order; the last one is the newest.
        fps: frame rate of the scene.

    >>> frames = [FrameTime(index, index * 33.3, index * 33.3) for index in range(3)]
    >>> time_warnings(frames, 30.0)[0].partition(";")[0]
    'the times are probably milliseconds: frame 2 has the time 66.6, and frames are 33.3 apart'
    """
    if not frames:
        return []
    newest, warnings = frames[-1], []
    steps = [(later.sent - earlier.sent) / (later.index - earlier.index) for earlier, later in pairwise(frames)]
    step = median_low([step for step in steps if step > 0] or [0.0])
    unit = _unit(step * fps)
    # Most steps may precede a correction of the unit, and a single step may be a pause.
    if (steps and _unit(steps[-1] * fps) != unit) or (len(steps) == 1 and not _is_near(step * fps, UNITS[unit])):
        unit = "seconds"
    unix = next((name for name, scale in UNITS.items() if 1e9 <= newest.sent / scale < 1e10), "")
    if step == 0 and unix:
        unit = unix
    if unit != "seconds" or unix == "seconds":
        what = f"Unix times in {unit}" if unit == unix else unit
        apart = f", and frames are {step!r} apart" if step else ""
        remedy = f"divide them by {UNITS[unit]:.0f}" if unit != "seconds" else "subtract that of the first frame"
        if step and unit != "seconds":
            remedy += f", or set the frame rate to {1 / step:.3g} if they are seconds"
        warnings.append(
            f"the times are probably {what}: frame {newest.index} has the time {newest.sent!r}{apart}; {remedy}"
        )
    if newest.time != newest.sent:
        fault = f"not within ±{LATEST_FIRST:.0f} s"
        if len(frames) > 1:
            fault = f"not 1 µs to 1 day after frame {frames[-2].index} at {frames[-2].time!r} s"
        warnings.append(
            f"frame {newest.index} has the time {newest.time!r} s instead of the sent {newest.sent!r} s, which is "
            f"{fault}; take the times from a clock that is never set, or omit them"
        )
    return warnings


def _unit(ratio: float) -> str:
    """Returns the probable unit of times whose steps are ``ratio`` times the interval at the frame rate."""
    if ratio < SUSPICIOUS:
        return "seconds"
    return next((unit for unit, scale in UNITS.items() if scale > 1 and ratio < scale * 10**1.5), "nanoseconds")


def _is_near(ratio: float, scale: float) -> bool:
    return scale / PAUSE_FACTOR <= ratio <= scale * PAUSE_FACTOR
