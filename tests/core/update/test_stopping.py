"""The number of iterations: counted, by a clock, and until nothing is gained; the budget of a frame."""

from __future__ import annotations

import pytest

from scas4d_core.update.schedule import (
    AFTER_S,
    COOLING,
    FOR_BIRTHS,
    LOOK_EVERY,
    MAX_TIMED,
    PROBE,
    RATE,
    Stopping,
    TimeBudget,
)


class Clock:
    """Time that passes when it is told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def iterate(pace: Stopping, clock: Clock, each: float, falls: float = 1.0) -> int:
    """The loop of an update whose iterations take so long, its error falling by a factor each; how many there were."""
    done, error = 0, 1.0
    while done < pace.planned(done):
        clock.now += each
        done += 1
        error *= falls
        if pace.needs_error(done):
            pace.record_error(done, error)
    return done


def test_counted_is_told_once() -> None:
    pace = Stopping(7)
    assert iterate(pace, Clock(), 1.0) == 7
    assert pace.planned_so_far == [(0, 7)]
    assert pace.most == 7


@pytest.mark.parametrize("believed", [None, 0.001, 0.01, 0.1])
@pytest.mark.parametrize("each", [0.004, 0.01, 0.03])
def test_timed_ends_in_time_whatever_was_believed(each: float, believed: float | None) -> None:
    clock = Clock()
    end = clock.now + 1.0
    count = iterate(Stopping(end=end, iteration_seconds=believed, clock=clock), clock, each)
    assert clock.now <= end + 1e-9
    if believed is None or believed <= 0.1:
        assert count >= 0.9 / each - 1


def test_timed_slows_down_with_the_machine() -> None:
    clock = Clock()
    pace, end, done = Stopping(end=clock.now + 1.0, iteration_seconds=0.01, clock=clock), clock.now + 1.0, 0
    while done < pace.planned(done):
        clock.now += 0.01 if done < 30 else 0.04
        done += 1
    assert clock.now <= end + 0.04
    assert [total for _, total in pace.planned_so_far][-1] < 100


def test_timed_takes_one_iteration_even_without_time_and_never_too_many() -> None:
    clock = Clock()
    assert iterate(Stopping(end=clock.now - 5, iteration_seconds=0.01, clock=clock), clock, 0.01) == 1
    assert Stopping(end=clock.now + 1e9, iteration_seconds=1e-6, clock=clock).planned(0) == MAX_TIMED
    assert PROBE >= 1


def test_until_met_cools_down_and_ends_where_nothing_is_gained() -> None:
    flat = Stopping(100, gain=0.05)
    assert iterate(flat, Clock(), 1.0) == 2 * LOOK_EVERY + round(COOLING * 100)
    falling = Stopping(100, gain=0.05)
    assert iterate(falling, Clock(), 1.0, falls=0.98) == 100
    assert flat.most == falling.most == 100


def test_until_met_waits_for_what_begins_late() -> None:
    assert iterate(Stopping(100, gain=0.05, first=0.5), Clock(), 1.0) == 50 + round(COOLING * 100)
    assert iterate(Stopping(30, gain=0.05, first=0.9), Clock(), 1.0) == 30


def test_what_was_decided_is_told() -> None:
    clock = Clock()
    pace = Stopping(end=clock.now + 1.0, iteration_seconds=0.02, gain=0.05, clock=clock)
    count = iterate(pace, clock, 0.013)
    assert [first for first, _ in pace.planned_so_far] == sorted({first for first, _ in pace.planned_so_far})
    assert pace.planned_so_far[-1][1] == count


def learn(
    budget: TimeBudget, iterations: int, each: float, start: float = 0.0, end: float = 0.0, commit: float = 0.02
) -> None:
    moments = [start + (k + 1) * each for k in range(iterations)]
    budget.record_frame(moments, {"start": start, "end": end}, commit)


def test_a_budget_learns_what_an_iteration_and_the_end_take() -> None:
    budget = TimeBudget(500.0)
    assert budget.end(10.0) == pytest.approx(10.5 - AFTER_S)
    learn(budget, 20, 0.01, start=0.1, end=0.03, commit=0.02)
    assert budget.iteration_seconds == pytest.approx(0.01)
    assert budget.after == pytest.approx(0.05)
    learn(budget, 20, 0.02, start=0.1, end=0.03, commit=0.12)
    assert budget.iteration_seconds == pytest.approx(0.01 + RATE * 0.01)
    assert budget.after == pytest.approx(0.05 + RATE * 0.10)
    before = (budget.iteration_seconds, budget.after)
    learn(budget, 0, 0.0, commit=9.0)
    assert (budget.iteration_seconds, budget.after) == before


def test_one_slow_frame_costs_the_next_one_its_iterations_but_no_more() -> None:
    budget = TimeBudget(500.0)
    for each in (0.01, 30.0, 0.01):
        learn(budget, 20, each, commit=0.02)
    assert budget.iteration_seconds == pytest.approx(0.01)


def test_without_a_budget_there_is_no_end() -> None:
    assert TimeBudget(None).end(3.0) is None
    assert TimeBudget(None).end_of_births(3.0) is None


def test_births_have_a_part_of_the_budget_where_the_frame_before_had_some() -> None:
    budget = TimeBudget(500.0)
    assert budget.end_of_births(10.0) == budget.end(10.0)
    budget.births = True
    assert budget.end_of_births(10.0) == pytest.approx(10.5 - AFTER_S)
    assert budget.end(10.0) == pytest.approx(10.5 - AFTER_S - FOR_BIRTHS * 0.5)
