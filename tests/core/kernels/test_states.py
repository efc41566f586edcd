"""Kernels on whole states against NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from scas4d_core.kernels.states import find_implausible


@pytest.mark.parametrize(
    ("array", "value"),
    [("means", 9), ("means", np.nan), ("factors", np.inf), ("rotations", 2), ("colours", np.nan), ("colours", -9)],
)
def test_a_faulty_row_is_marked(array: str, value: float) -> None:
    means, factors = np.zeros((4, 3), np.float32), np.tile(np.eye(3, dtype=np.float32), (4, 1, 1))
    state = {"means": means.copy(), "factors": factors.copy(), "rotations": np.eye(4, dtype=np.float32)[[0] * 4]}
    state |= {"colours": np.zeros((4, 3), np.float32)}
    bad, squares = np.empty(4, np.bool_), np.empty((4, 3), np.float32)
    limits = np.float32(1), np.float32(4), np.float32(8)
    find_implausible(means, factors, *state.values(), np.arange(4), *limits, bad, squares)
    assert not bad.any()
    assert (squares == 1).all()
    state[array][2] = value
    find_implausible(means, factors, *state.values(), np.arange(4), *limits, bad, squares)
    np.testing.assert_array_equal(bad, [False, False, True, False])


def test_a_mirrored_factor_is_marked() -> None:
    means, factors = np.zeros((2, 3), np.float32), np.tile(np.eye(3, dtype=np.float32), (2, 1, 1))
    mirrored = factors.copy()
    mirrored[1, 0] *= -1
    rotations, bad = np.eye(4, dtype=np.float32)[[0, 0]], np.empty(2, np.bool_)
    find_implausible(
        means, factors, means, mirrored, rotations, means, np.arange(2), np.float32(1), np.float32(4), np.float32(8),
        bad, np.empty((2, 3), np.float32),
    )  # fmt: skip
    np.testing.assert_array_equal(bad, [False, True])
