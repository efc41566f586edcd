"""Captures whose cameras drift: pictures turn as the camera does, and four ways are measured and kept."""

from pathlib import Path

import numpy as np

from scas4d_core.captures import open_capture
from studies.rigs import pose_drift

SAMPLE = Path(__file__).parents[3] / "samples" / "robot"
QUICK = ("scene.image_scale=0.25", "static.iterations=20", "static.max_gaussians=500", "update.iterations=8")


def test_pictures_of_a_camera_that_turns_shift_by_so_many_pixels():
    capture = open_capture(SAMPLE)
    name = capture.rig.names[0]
    before = capture.frame(1)
    after = pose_drift.turned(capture, 1, {name: np.array([3.0, -2.0, 0.0])})
    for frames, within in ((("images", "images"), 8), (("masks", "masks"), 0.05)):
        old, new = (
            np.asarray(getattr(frame, kind)[name], float) for frame, kind in zip((before, after), frames, strict=True)
        )
        middle = (slice(80, 176), slice(80, 176))
        there = np.roll(old, (-2, 3), axis=(0, 1))
        assert np.abs(new - there)[middle].mean() < within
        assert np.abs(new - there)[middle].mean() < 0.5 * np.abs(new - old)[middle].mean()
    other = capture.rig.names[1]
    np.testing.assert_array_equal(after.images[other], before.images[other])


def test_four_ways_are_measured_and_kept(tmp_path):
    lines = list[str]()
    rows = pose_drift.run([SAMPLE], tmp_path, updates=2, changes=QUICK, report=lines.append)
    assert [(row["cameras"], row["poses"]) for row in rows] == [
        ("stand", "off"), ("stand", "auto"), ("drift", "off"), ("drift", "auto"),
    ]  # fmt: skip
    assert rows[0]["psnr"] == rows[1]["psnr"] != rows[2]["psnr"]  # cameras that stand: the same bits
    assert rows[1]["followed"] == []
    assert rows[2]["true"].count("0.15") == 2  # two frames of 0.3 pixels, at a quarter of the size
    assert pose_drift.run([SAMPLE], tmp_path, updates=2, changes=QUICK, report=lines.append) == rows
    assert "| drift | auto |" in (tmp_path / "drift.md").read_text()
