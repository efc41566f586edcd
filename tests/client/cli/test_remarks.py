"""The lines of `scas4d reconstruct` on a frame: one that was held says so, and alarms are remarks_on once."""

from __future__ import annotations

from client.cli.reconstruct import remarks_on
from scas4d_core.frame_outcome import Alarm, AlarmKind, FrameOutcome
from scas4d_core.frame_report import FrameReport


def report(**more: object) -> FrameReport:
    return FrameReport(3, 0.1, 100, {}, [], 30.0, 10, 10, **more)  # type: ignore[arg-type]


def test_a_frame_that_went_as_it_should_has_no_more_lines() -> None:
    assert remarks_on(None) == remarks_on(report()) == ""


def test_a_held_frame_and_its_alarms_are_told_once() -> None:
    why = "previous state kept: the pictures are met at 20.6 dB, 19.4 dB less than usual"
    alarms = [
        Alarm(AlarmKind.FRAME_REJECTED, None, "the pictures are met at 20.6 dB"),
        Alarm(AlarmKind.CAMERA_LEFT_OUT, "cam2", "no picture came"),
    ]
    held = report(outcome=FrameOutcome.REJECTED_MISFIT, degraded=why, alarms=alarms)
    assert remarks_on(held).splitlines() == ["", f"  ! {why}", "  ! camera cam2: no picture came"]
