"""Streams in which some cameras take their pictures between the frames, and what is told of a run."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from scas4d_core.captures.frame import Frame
from studies.hard_frames.out_of_step import played, summary


class Counted:
    """A capture of five frames, whose pictures are the numbers of their frames; one camera has masks."""

    frame_count = 5

    def frame(self, index: int) -> Frame:
        assert 0 <= index < self.frame_count
        picture = np.full((2, 2, 3), index, np.uint8)
        return Frame(index, 10.0 + index, dict.fromkeys("ab", picture), {"a": picture[..., 0]})


def numbers(step: int, shifts: dict[str, int], count: int = 6) -> list[tuple[int, int, int]]:
    capture: Any = Counted()
    frames = [played(capture, index, step, shifts) for index in range(1, count + 1)]
    assert [frame.index for frame in frames] == list(range(1, count + 1))
    assert np.allclose(np.diff([frame.time for frame in frames]), 1 / 30)
    return [
        (int(frame.images["a"].max()), int(frame.masks["a"].max()), int(frame.images["b"].max())) for frame in frames
    ]


def test_a_capture_is_played_there_and_back_and_a_camera_sees_between_its_frames() -> None:
    assert [b for _, _, b in numbers(2, {})] == [2, 4, 2, 0, 2, 4]
    late = numbers(2, {"a": 1})
    assert [a for a, _, _ in late] == [3, 3, 1, 1, 3, 3]  # of what is going back, the next one lies before
    assert all(picture == mask for picture, mask, _ in late)
    assert [b for _, _, b in late] == [2, 4, 2, 0, 2, 4]
    assert [a for a, _, _ in numbers(2, {"a": -1})] == [1, 3, 3, 1, 1, 3]


def report(**timing: float) -> Any:
    rows = {name: {"frames": way, "error": 0.02, "out_of_step": abs(way) > 0.2} for name, way in timing.items()}
    return SimpleNamespace(timing=rows)


def test_a_run_is_told_in_a_row() -> None:
    reports = [report(), report(a=0.1, b=-0.3, c=0.01), report(a=0.4, c=0.05), report(a=0.42, c=-0.02)]
    row = summary(reports, {"a": 0.5, "d": -0.5})
    assert row["found"] == "a: +0.42 ± 0.02; d: not known"
    assert row["since"] == "3; –"
    assert row["others"] == 0.3
    assert row["wrong"] == 1  # b, once
    assert row["known"] == 2
