"""What is said about images and masks of frame 0 that do not show a scene."""

from __future__ import annotations

import numpy as np
import pytest

from scas4d_core.captures import open_capture
from scas4d_core.first_frame.image_warnings import image_warnings


@pytest.fixture(scope="module")
def frame():
    return open_capture("samples/robot", image_scale=0.25).frame(0)


def test_a_usual_frame_has_no_warnings(frame):
    assert image_warnings(dict(frame.images), dict(frame.masks)) == []


def noisy(level, amplitude=3):
    rng = np.random.default_rng(level)
    return np.clip(level + rng.integers(-amplitude, amplitude + 1, (64, 64, 3)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("level", "said"),
    [
        (4, "black (0, 1, 2, 3, 5, 6, 7, 9 and 8 more); a covered lens"),
        (253, "white (0, 1, 2, 3, 5, 6, 7, 9 and 8 more); the exposure"),
        (120, "of a single colour (0, 1, 2, 3, 5, 6, 7, 9 and 8 more); the camera"),
    ],
)
def test_images_that_show_nothing(frame, level, said):
    assert image_warnings({name: noisy(level) for name in frame.images}, {})[0].startswith(f"all 16 images are {said}")


def test_half_of_the_lenses_are_covered(frame):
    images = {name: noisy(4) if i % 2 else image for i, (name, image) in enumerate(frame.images.items())}
    (said,) = image_warnings(images, {})
    assert said.startswith("8 of 16 images are black (1, 3, 6, 9, 16, 19, 22, 25); a covered lens")


def test_one_image_for_several_cameras(frame):
    images = dict(frame.images) | {name: frame.images["0"] for name in ("5", "7")}
    (said,) = image_warnings(images, {})
    assert said.startswith("3 of 16 images are identical (0, 5, 7); ")


@pytest.mark.parametrize(("value", "said"), [(0, "all masks are empty"), (1, "all masks are full")])
def test_masks_that_separate_nothing(frame, value, said):
    masks = {name: np.full_like(mask, value) for name, mask in frame.masks.items()}
    assert image_warnings(dict(frame.images), masks)[0].startswith(said)
    masks["0"] = frame.masks["0"]
    assert image_warnings(dict(frame.images), masks) == []
