"""The study of skipped frames compares the same frames, from one frame 0."""

from __future__ import annotations

from pathlib import Path

import pytest

from studies.captures import open_measured
from studies.quality.settings import settings_of
from studies.variants.gaps import GapResult, measure, page

SAMPLE = Path(__file__).parents[3] / "samples" / "robot"
CHANGES = ("scene.image_scale=0.125", "static.iterations=100", "static.max_gaussians=800", "update.iterations=10")


@pytest.mark.slow
def test_only_the_frames_that_both_commit_are_compared():
    capture, settings = open_measured(SAMPLE), settings_of("scas4d", changes=CHANGES)
    truth = open_measured(SAMPLE, image_scale=settings.scene.image_scale)
    result = measure(capture, truth, settings, frames=6, step=2)
    assert list(result.frames) == [2, 4]
    assert len(result.psnr) == len(result.psnr_gaps) == 2
    assert result.psnr != result.psnr_gaps


def test_the_page_counts_captures_within_the_target():
    near = GapResult("near", [3, 6], [30.0, 32.0], [29.8, 31.6], (1.0, 1.5), (0, 0), (0.1, 0.2), ())
    lost = GapResult("lost", [3, 6], [30.0, 32.0], [29.8, 31.6], (1.0, 1.0), (0, 1), (0.1, 0.2), ("3 relocated",))
    text = page([near, lost], step=3)
    assert near.differences == pytest.approx([-0.2, -0.4])
    assert "| near | 2 | 31.00 | -0.30 (-0.40) dB | 0 → 0 | 0.10 → 0.20 | 1.50 × |  |" in text
    assert "1 of 2 captures" in text
