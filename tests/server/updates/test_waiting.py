"""The prediction of when a queue has room, and the pauses between a worker's end and the next one's start."""

from __future__ import annotations

import asyncio

import pytest
from running import make_rig
from virtual_clock import run_virtual
from waiting import Hand

from scas4d_core.presets import preset
from server.messages import SceneSpec
from server.processes.placement import ProcessExit
from server.storage.layout import SceneFolder
from server.updates.work_clock import FIRST_GUESS_S, OVERDUE, SHORTEST_S, UPDATES_KEPT, WorkClock
from server.updates.worker_process import WorkerProcess


@pytest.fixture
def hand():
    return Hand(100.0)


@pytest.fixture
def clock(hand):
    return WorkClock(hand)


def run(clock, hand, seconds, first=False):
    clock.begin(first=first)
    hand.at += seconds
    clock.end(committed=True)


def test_frame_0_is_never_taken_for_an_update(clock, hand):
    run(clock, hand, 300, first=True)
    assert clock.remaining() == FIRST_GUESS_S
    run(clock, hand, 0.7)
    assert clock.remaining() == pytest.approx(0.7)


def test_frame_0_says_itself_when_it_ends(clock, hand):
    clock.begin(first=True)
    hand.at += 10
    clock.progress("fitting frame 0", 100, 3000, 40.0)
    hand.at += 15
    assert clock.remaining() == pytest.approx(25)
    hand.at += 40  # it did not: what is known is how far it is
    clock.progress("fitting frame 0", 2750, 3000)
    assert clock.remaining() == pytest.approx(5)


def test_an_update_is_the_median_of_the_last_ones_less_what_has_gone(clock, hand):
    for seconds in (9, 9, 9, *[0.5] * UPDATES_KEPT):
        run(clock, hand, seconds)
    clock.begin(first=False)
    hand.at += 0.2
    assert clock.remaining() == pytest.approx(0.3)
    hand.at += 0.29
    assert clock.remaining() == SHORTEST_S
    hand.at += 10
    assert clock.remaining() == pytest.approx(OVERDUE * (10.49 - 0.5))


def test_frame_0_is_predicted_from_its_progress(clock, hand):
    clock.begin(first=True)
    hand.at += 8
    assert clock.remaining() == pytest.approx(2)  # nothing is known yet
    clock.progress("fitting", 0, 100)
    hand.at += 10
    clock.progress("fitting", 25, 100)
    assert clock.remaining() == pytest.approx(30)
    hand.at += 25
    clock.progress("fitting", 90, 100)
    assert clock.remaining() == pytest.approx(35 / 9)
    clock.progress("fitting", 100, 100)
    assert clock.remaining() == pytest.approx(OVERDUE * 43)


def test_a_full_disk_is_waited_for_and_says_nothing_of_updates(clock, hand):
    run(clock, hand, 0.5)
    clock.begin(first=False)
    clock.stall(8)
    hand.at += 3
    assert clock.remaining() == pytest.approx(5.5)
    hand.at += 20
    assert clock.remaining() == pytest.approx(0.5)
    clock.end(committed=True)
    assert clock.update_seconds == 0.5


def test_a_frame_set_aside_says_nothing_of_updates(clock, hand):
    clock.begin(first=False)
    hand.at += 30
    clock.end(committed=False)
    clock.end(committed=True)  # nothing is at work: nothing is measured
    assert clock.remaining() == FIRST_GUESS_S


class Processes:
    """A placement whose processes end when they are told to."""

    fenced = False

    def __init__(self):
        self.ends = []

    def start(self, entry, spec, on_message, on_end):
        self.ends.append(on_end)
        return object()


def test_nothing_starts_a_worker_before_the_pause_after_its_end_is_over(tmp_path):
    """A frame may come, or the journal take a while, between its end and what is said about the next.

    The loop has a clock of its own, which jumps to what is due next.
    """

    async def deaths():
        there = Processes()
        spec = SceneSpec(SceneFolder(tmp_path), make_rig(), preset("scas4d"))
        process = WorkerProcess(spec, there)
        process.listen(lambda message: None, lambda why: None)
        process.start()
        for seconds in (1, 30):
            there.ends[-1](ProcessExit(-9))
            process.start()
            assert not process.starts_again
            process.start_in(seconds)
            process.start()
            assert process.starts_again
            count = len(there.ends)
            await asyncio.sleep(seconds / 2)
            assert len(there.ends) == count
            await asyncio.sleep(seconds)
            assert len(there.ends) == count + 1
            assert not process.starts_again
        process.close()
        there.ends[-1](ProcessExit(-9))
        process.start_in(0)
        await asyncio.sleep(60)
        assert len(there.ends) == 3

    run_virtual(deaths())
