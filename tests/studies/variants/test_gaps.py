"""The study of skipped frames: its queue follows the service's rules, and its runs are compared on their own frames."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest

from studies.captures import open_measured
from studies.quality.settings import settings_of
from studies.variants.gaps import GapResult, GapRun, Queue, measure, page

SAMPLE = Path(__file__).parents[3] / "samples" / "robot"
CHANGES = ("scene.image_scale=0.125", "static.iterations=100", "static.max_gaussians=800", "update.iterations=10")


@pytest.mark.slow
def test_every_run_is_compared_on_the_frames_that_it_commits():
    capture, settings = open_measured(SAMPLE), settings_of("scas4d", changes=CHANGES)
    truth = open_measured(SAMPLE, image_scale=settings.scene.image_scale)
    result = measure(capture, truth, settings, frames=6, step=2, queue_frames=4)
    gaps, shorter, policy = result.runs
    assert list(result.full.psnr) == list(shorter.psnr) == [1, 2, 3, 4, 5]
    assert list(gaps.psnr) == [2, 4]
    assert set(policy.psnr) <= set(result.full.psnr)
    assert len({run.psnr[4] for run in (result.full, gaps, shorter)}) == 3


@pytest.mark.parametrize("intervals", [0.5, 1.0])
def test_a_scene_that_keeps_up_skips_nothing(intervals):
    queue, committed = Queue(9, length=4), []
    while (index := queue.next()) is not None:
        assert queue.waiting == 0
        committed.append(index)
        queue.spend(intervals)
    assert committed == [*range(1, 9)]


def test_a_full_queue_skips_to_the_newest_frame():
    queue, committed = Queue(40, length=4), []
    while (index := queue.next()) is not None:
        committed.append(index)
        queue.spend(3.0)
        assert queue.waiting < 4
    steps = [after - before for before, after in pairwise(committed)]
    assert sum(steps) / len(steps) == pytest.approx(3, abs=0.5)
    assert max(steps) > 3
    assert committed[-1] == 39


def test_the_page_counts_captures_within_the_target():
    full = GapRun("all frames", {1: 30.0, 3: 31.0, 6: 32.0}, 1, 0.1)
    near, far = GapRun("near", {3: 30.8, 6: 31.6}, 1, 0.2), GapRun("far", {3: 30.8, 6: 31.6}, 2, 0.2)
    result = GapResult("robot", full, [near, far])
    assert result.differences(near) == pytest.approx([-0.2, -0.4])
    text = page([result], step=3)
    assert "| robot | near | 2 | -0.30 | -0.40 | 1 | 0.20 |" in text
    assert text.endswith("- near: 1 of 1\n- far: 0 of 1")
