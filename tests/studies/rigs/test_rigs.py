"""Captures of other rigs: seconds of frame 0, and a camera held out."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from client.importers.open_source import CaptureOptions
from studies.rigs import rigs

SAMPLE = Path(__file__).parents[3] / "samples" / "robot"
QUICK = ("static.iterations=20", "static.max_gaussians=500", "update.iterations=4")


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures") / "robot"
    shutil.copytree(SAMPLE, folder)
    out = tmp_path_factory.mktemp("study")
    options = CaptureOptions(test=("4",))
    found = [
        rigs.run([folder], out, frames=2, longer=64, changes=QUICK, options=options, report=lambda _: None)
        for _ in range(2)
    ]
    return out, found


def test_a_rig_is_measured_as_it_is_given(measured):
    out, (first, again) = measured
    (row,) = first
    assert row["frames"] == 2
    assert row["pixels"] == "64×64"
    assert row["seconds_first"] > 0
    assert 0 < row["pairs"] < row["pairs_99"]
    assert row["held_out"] == "4, 11"
    assert row["psnr_training"] > row["psnr_nearest"]
    assert row["psnr_held_out"] > 5
    assert again == first  # what is on disk is not measured again
    assert "| robot |" in (out / "rigs.md").read_text()


def test_pictures_of_another_size_are_compared_by_their_nearest_pixels():
    small = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    large = rigs._resized(small, (4, 4, 3))
    assert (large[::2, ::2] == small).all()
    assert (large[1::2, 1::2] == small).all()
