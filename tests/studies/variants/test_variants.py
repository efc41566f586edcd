"""Variants show the frames that they say, with their truth; contenders are compared place by place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scas4d_core.captures import open_capture
from studies.variants import screen
from studies.variants.page import page
from studies.variants.screen import Contender
from studies.variants.variants import VARIANTS, of_frames

SAMPLE = Path(__file__).parents[3] / "samples" / "robot"
QUICK = "scene.image_scale=0.25 static.iterations=20 static.max_gaussians=500 update.iterations=3"

CAPTURE = open_capture(SAMPLE)
LAST = CAPTURE.frame_count - 1


@pytest.mark.parametrize(
    ("name", "frames"),
    [
        ("as it is", range(LAST + 1)),
        ("backwards", range(LAST, -1, -1)),
        ("every second", range(0, LAST + 1, 2)),
        ("later", range((LAST + 1) // 3, LAST + 1)),
    ],
)
def test_a_variant_shows_its_frames_with_their_truth(name, frames):
    variant = VARIANTS[name].made(CAPTURE)
    assert variant.frame_count == len(frames)
    step = 2 if name == "every second" else 1
    assert variant.time(1) - variant.time(0) == pytest.approx(step / CAPTURE.fps)
    assert (variant.points is None) == (frames[0] != 0)
    for index in (0, 1, len(frames) - 1):
        there = frames[index]
        now, truth = variant.frame(index), CAPTURE.frame(there)
        assert np.array_equal(now.images["0"], truth.images["0"])
        assert np.array_equal(now.masks["0"], truth.masks["0"])
        assert np.array_equal(variant.test_frame(index).images["4"], CAPTURE.test_frame(there).images["4"])
        assert variant.encoded_image(index, "4") == CAPTURE.encoded_image(there, "4")
        assert np.array_equal(variant.ground_truth.points[index], CAPTURE.ground_truth.points[there])
        assert np.array_equal(variant.ground_truth.visible[index], CAPTURE.ground_truth.visible[there])
        camera = CAPTURE.ground_truth.label_cameras[0]
        assert np.array_equal(variant.ground_truth.labels(camera, index), CAPTURE.ground_truth.labels(camera, there))
        for part, whole in zip(variant.ground_truth.parts, CAPTURE.ground_truth.parts, strict=True):
            assert part.pose is None or np.array_equal(part.pose[index], whole.pose[there])


def test_half_the_cameras_leaves_the_test_cameras():
    half = VARIANTS["half the cameras"].made(CAPTURE)
    assert half.full_rig.names == CAPTURE.full_rig.names[::2]
    assert half.full_test_rig == CAPTURE.full_test_rig


def test_times_of_pictures_rise_backwards():
    class Timed:
        frame_count = 3

        def time(self, index):
            return (5.0, 5.1, 5.4)[index]

    from dataclasses import replace

    timed = replace(CAPTURE, pictures=Timed(), ground_truth=None)
    assert [of_frames(timed, (2, 1, 0)).time(i) for i in range(3)] == pytest.approx([0, 0.3, 0.4])


@pytest.mark.parametrize("text", ["a: update.iterations", ": update.iterations=3"])
def test_a_contender_that_cannot_be_read_is_refused(text):
    with pytest.raises(ValueError, match=r"invalid contender .*; use the form"):
        Contender.read(text)


def row(capture, of, contender, psnr, seconds=1.0, **more):
    return {
        "capture": capture, "of": of, "contender": contender, "seed": 0, "psnr": psnr, "psnr_first": 35.0,
        "seconds_update": seconds, "updates": 5, **more,
    }  # fmt: skip


def test_the_page_tells_gains():
    """`b` wins on two captures and loses on the third; `c` wins a little everywhere."""
    gains = {"one": (1.0, 0.2), "two": (1.0, 0.2), "three": (-1.2, 0.2)}
    rows = []
    for capture, (b, c) in gains.items():
        rows += [row(capture, "later", "a", 30.0), row(capture, "later", "b", 30 + b, 0.5)]
        rows += [row(capture, "later", "c", 30 + c)]
    text = page(rows, ["a", "b", "c"])
    assert "**b**: +0.27 dB at 0.50 × the time; not behind on 67% of 3; worst -1.20 dB (three, later)." in text
    assert "| one | later | 35.00 | 30.00 | – | +1.00; 0.50; – | +0.20; 1.00; – |" in text


def test_a_failed_row_is_left_out_of_the_page():
    rows = [row("one", "later", "a", 30.0), row("one", "later", "b", 31.0) | {"error": "killed"}]
    text = page(rows, ["a", "b"])
    assert "| one | later | 35.00 | 30.00 | – | – |" in text
    assert "**b**" not in text


def test_contenders_are_measured_from_one_frame_0_and_not_twice(tmp_path):
    contenders = [Contender.read(f"short: {QUICK}"), Contender.read(f"longer: {QUICK} update.iterations=9")]
    said: list[str] = []
    for _ in range(2):
        said.clear()
        text = screen.run([SAMPLE], contenders, tmp_path, variants=["backwards"], frames=2, report=said.append)
    assert sum("already measured" in line for line in said) == 2
    assert len(list((tmp_path / "first").iterdir())) == 1
    assert "| robot | backwards |" in text
    assert "**longer**" in (tmp_path / "variants.md").read_text()
