"""The latency of frames by stage, and how far a scene is behind its cameras."""

from __future__ import annotations

import pytest
from waiting import Hand

from server.updates.latency import FRAMES_KEPT, Latencies


@pytest.fixture
def clock():
    return Hand()


@pytest.fixture
def latencies(clock):
    return Latencies(clock)


def test_the_last_start_counts_after_a_crash(latencies, clock):
    for at, step in ((0, "receive"), (1, "start"), (2, "solve"), (5, "start"), (7, "solve"), (8, "commit")):
        clock.at = at
        getattr(latencies, step)(3)
    latency = latencies.of(3)
    assert (latency.queue, latency.update, latency.commit, latency.total) == (5, 2, 1, 8)


def test_frames_from_before_a_restart_have_no_latency(latencies):
    for step in ("start", "solve", "commit"):
        getattr(latencies, step)(3)
    assert latencies.of(3) is None
    assert latencies.behind([3]) == 0


def test_the_oldest_unfinished_frame_decides_how_far_the_scene_is_behind(latencies, clock):
    for index in range(4):
        clock.at = index
        latencies.receive(index)
    clock.at = 10
    assert latencies.behind([2, 1, 3]) == 9
    assert latencies.behind([]) == 0


def test_a_long_take_needs_no_more_memory(latencies):
    for index in range(3 * FRAMES_KEPT):
        latencies.receive(index)
    assert latencies.behind([0]) == 0
    assert len(latencies._frames) == FRAMES_KEPT
