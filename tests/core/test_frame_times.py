"""Times of a scene from the times that a rig sends, and suspected units."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from scas4d_core.errors import InputError
from scas4d_core.frame_times import LONGEST_STEP, MAX_TIME, ROWS, FrameTime, check_time, time_after, time_warnings

FPS = 30.0
START = 1764363600.5
"""A Unix time."""


def scene_of(sent: list[float], fps: float = FPS, indices: list[int] | None = None) -> list[FrameTime]:
    """Frames of a scene that sends these times."""
    frames: list[FrameTime] = []
    for index, time in zip(indices or range(len(sent)), sent, strict=False):
        frames.append(FrameTime(index, time_after(frames[-1] if frames else None, index, time, fps), time))
    return frames


def times(sent: list[float]) -> list[float]:
    return [frame.time for frame in scene_of(sent)]


def warnings(sent: list[float], fps: float = FPS) -> list[str]:
    return time_warnings(scene_of(sent, fps)[-ROWS:], fps)


def regular(count: int, start: float = 0.0, scale: float = 1.0) -> list[float]:
    return [(start + index / FPS) * scale for index in range(count)]


def steps(scene: list[float]) -> list[float]:
    return [after - before for before, after in pairwise(scene)]


SENT = st.floats(-MAX_TIME, MAX_TIME) | st.floats(-100, 100) | st.sampled_from([0.0, 5e-324, 1e10, 1e18, MAX_TIME])


@given(st.lists(st.tuples(st.integers(1, 10**6), SENT), max_size=20), st.floats(1e-4, 1e4))
def test_times_always_increase_and_never_by_more_than_a_day_or_the_missing_frames(
    rows: list[tuple[int, float]], fps: float
) -> None:
    indices = [sum(step for step, _ in rows[: place + 1]) for place in range(len(rows))]
    frames = scene_of([sent for _, sent in rows], fps, indices)
    for before, after in pairwise(frames):
        step = max(LONGEST_STEP, (after.index - before.index) / fps)
        assert 0 < after.time - before.time <= 1.001 * step
    for count in range(len(frames) + 1):
        time_warnings(frames[:count][-ROWS:], fps)


@pytest.mark.parametrize("start", [0.0, 12.5, START])
def test_increasing_times_are_used_as_sent(start: float) -> None:
    sent = [*regular(5, start), start + 3600]  # with a pause
    assert times(sent) == sent
    assert not any("instead of the sent" in text for text in warnings(sent))


@pytest.mark.parametrize("wrong", [0.0, 1e6, 1e18, 1.0])
def test_one_wrong_time_changes_no_later_interval(wrong: float) -> None:
    sent = regular(12, 1.0)
    sent[5] = wrong
    assert steps(times(sent)) == pytest.approx([1 / FPS] * 11)


def test_a_frame_from_the_near_future_leaves_one_gap() -> None:
    sent = regular(12)
    sent[5] += 100
    scene = times(sent)
    assert scene[5] == sent[5]
    assert steps(scene[5:]) == pytest.approx([1 / FPS] * 6)


@pytest.mark.parametrize("second", [0.0, 8.0, START - 7200])
def test_a_clock_that_was_set_back_shifts_all_later_times(second: float) -> None:
    sent = [*regular(5, START), *regular(5, second)]
    scene = times(sent)
    assert scene[:5] == sent[:5]
    assert steps(scene) == pytest.approx([1 / FPS] * 9, abs=1e-6)
    assert f"frame 9 has the time {scene[9]!r} s instead of the sent {sent[9]!r} s, " in warnings(sent)[-1]


def test_the_same_time_for_every_frame_gives_the_frame_rate() -> None:
    assert times([7.0] * 4) == pytest.approx([7 + index / FPS for index in range(4)])


@pytest.mark.parametrize(
    ("scale", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")], ids=["ms", "us", "ns"]
)
def test_units_are_named_with_a_remedy_that_works(scale: float, unit: str) -> None:
    for count in range(2, 20):
        text = warnings(regular(count, scale=scale))[0]
        assert text.startswith(f"the times are probably {unit}: frame {count - 1} has the time ")
        assert f"divide them by {scale:.0f}" in text
    for count in (1, 2, 20):
        text = warnings(regular(count, START, scale))[0]
        assert text.startswith(f"the times are probably Unix times in {unit}: ")
    assert not warnings([time / scale for time in regular(20, scale=scale)])
    [_, rate] = warnings(regular(5, scale=scale))[0].rsplit("set the frame rate to ")
    if scale < 1e9:  # steps of nanoseconds exceed a day
        assert not warnings(regular(5, scale=scale), float(rate.split()[0]))


def test_unix_times_are_named_and_used() -> None:
    for count in (1, 5):
        sent = regular(count, START)
        assert times(sent) == sent
        [text] = warnings(sent)
        assert text.startswith(
            f"the times are probably Unix times in seconds: frame {count - 1} has the time {sent[-1]!r}"
        )


def test_times_before_a_trigger_are_used() -> None:
    sent = [check_time(time) for time in regular(40, -1.0)]
    assert times(sent) == sent
    assert not warnings(sent)


@pytest.mark.parametrize("scale", [1e3, 1e6, 1e9])
@pytest.mark.parametrize("before", [1, 2, 5, 20])
def test_a_corrected_unit_is_not_named_again(scale: float, before: int) -> None:
    sent = [*(time * scale for time in regular(before)), *regular(20)[before:]]
    assert before == 1 or "probably" in warnings(sent[:before])[0]
    for count in range(before + 1, 20):
        assert not [text for text in warnings(sent[:count]) if "probably" in text]


@pytest.mark.parametrize("seconds", [500.0, 5e3])
@pytest.mark.parametrize("before", [1, 2, 5])
def test_one_jump_is_no_unit(seconds: float, before: int) -> None:
    sent = [*regular(before), *(seconds + time for time in regular(12)[before:])]
    for count in range(1, 12):
        assert not [text for text in warnings(sent[:count]) if "probably" in text]


@pytest.mark.parametrize("seconds", [2.0, 33.0])
def test_a_pause_is_no_unit(seconds: float) -> None:
    sent = [*regular(4), *regular(4, seconds)]
    for count in range(2, 9):
        assert not warnings(sent[:count])


@pytest.mark.parametrize("seconds", [float("nan"), float("inf"), -float("inf"), 1e300, 2 * MAX_TIME, -2 * MAX_TIME])
def test_other_times_are_refused_by_value(seconds: float) -> None:
    with pytest.raises(InputError) as error:
        check_time(seconds)
    assert repr(seconds) in error.value.fault
    assert error.value.remedy
