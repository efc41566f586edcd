"""Kernels for 8-bit images against NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import maximum_filter

from scas4d_core.kernels.pictures import fill_planes, mark_changes

RNG = np.random.default_rng(0)
IMAGE = RNG.integers(0, 256, (13, 21, 3)).astype(np.uint8)


def test_planes_are_the_values_divided_by_255() -> None:
    planes = np.full((4, 13, 21), 7, np.float32)
    fill_planes(IMAGE, planes)
    np.testing.assert_array_equal(planes[:3], np.moveaxis(IMAGE, -1, 0) * np.float32(1 / 255))
    assert (planes[3] == 7).all()


@pytest.mark.parametrize("pixels", [1, 5, 100])
def test_changed_pixels_are_marked_with_their_surroundings(pixels: int) -> None:
    now = IMAGE.copy()
    rows, columns = RNG.integers(0, 13, pixels), RNG.integers(0, 21, pixels)
    now[rows, columns, RNG.integers(0, 3, pixels)] ^= RNG.integers(1, 64, pixels).astype(np.uint8)
    differs = np.abs(now.astype(int) - IMAGE).max(axis=2) > 10
    marked = np.empty((13, 21), np.float32)
    assert mark_changes(IMAGE, now, 10, 2, marked) == differs.any()
    np.testing.assert_array_equal(marked, maximum_filter(differs, 5, mode="constant"))


def test_equal_images_have_no_changes() -> None:
    marked = np.ones((13, 21), np.float32)
    assert not mark_changes(IMAGE, IMAGE, 0, 2, marked)
    assert not marked.any()
