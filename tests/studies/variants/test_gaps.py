"""The study of skipped frames compares the same frames, from one frame 0."""

from __future__ import annotations

from pathlib import Path

import pytest

from studies.captures import open_measured
from studies.quality.settings import settings_of
from studies.variants.gaps import GapResult, GapRun, measure, page

SAMPLE = Path(__file__).parents[3] / "samples" / "robot"
CHANGES = ("scene.image_scale=0.125", "static.iterations=100", "static.max_gaussians=800", "update.iterations=10")


@pytest.mark.slow
def test_only_the_frames_that_all_runs_commit_are_compared():
    capture, settings = open_measured(SAMPLE), settings_of("scas4d", changes=CHANGES)
    truth = open_measured(SAMPLE, image_scale=settings.scene.image_scale)
    result = measure(capture, truth, settings, frames=6, step=2)
    found = [tuple(run.psnr) for run in (result.full, result.gaps, result.shorter)]
    assert [len(psnr) for psnr in found] == [2, 2, 2]
    assert len(set(found)) == 3


def test_the_page_counts_captures_within_the_target():
    full = GapRun([30.0, 32.0], 1.0, 1, 0.1)
    near, far = GapRun([29.8, 31.6], 1.5, 1, 0.2), GapRun([29.8, 31.6], 0.4, 2, 0.2)
    result = GapResult("robot", full, far, near)
    assert result.differences(near) == pytest.approx([-0.2, -0.4])
    text = page([result], step=3)
    assert "| robot | gaps | 30.70 | -0.30 (-0.40) | 2 | 0.20 | 0.40 |" in text
    assert "0 of 1 captures with gaps, 1 with shorter updates" in text
