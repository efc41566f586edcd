"""Kernels on whole states against NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from scas4d_core.kernels.states import (
    axes_are_within,
    count_votes,
    extrapolate_rows,
    find_finite,
    find_implausible,
    find_outside,
    rotate_rows,
)

RNG = np.random.default_rng(0)


def test_rotations_of_vectors_have_the_bits_of_the_formula() -> None:
    r, which, vectors = RNG.normal(size=(5, 3)), RNG.integers(0, 5, 40).astype(np.int32), RNG.normal(size=(40, 3))
    rotated = np.empty_like(vectors)
    rotate_rows(r, which, vectors, rotated)
    cross = np.cross(r[which], vectors)
    scale = 1 + np.square(r[which]).sum(axis=1, keepdims=True)
    np.testing.assert_array_equal(rotated, vectors + 2 * (cross + np.cross(r[which], cross)) / scale)


def test_only_moving_rows_are_extrapolated() -> None:
    before, after = RNG.normal(size=(2, 20, 9)).astype(np.float32)
    moving = np.arange(20) % 2 == 0
    result = np.empty_like(after)
    extrapolate_rows(before, after, moving, np.float32(0.5), result)
    expected = np.where(moving[:, None], after + np.float32(0.5) * (after - before), after)
    np.testing.assert_array_equal(result, expected)


def test_votes_are_counted_for_gaussians_that_are_seen() -> None:
    gathered = np.array([[5, 4], [5, 2], [1, 1], [np.nan, 1]], np.float32)
    asked, says = np.full(4, 3), np.full(4, 1)
    count_votes(gathered, np.float32(2), np.float32(0.5), asked, says)
    assert (asked.tolist(), says.tolist()) == ([4, 4, 3, 3], [2, 1, 1, 1])


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_rows_with_values_that_are_not_finite_are_not_marked(value: float) -> None:
    means, factors = np.zeros((5, 3), np.float32), np.zeros((5, 3, 3), np.float32)
    means[1, 2] = factors[3, 0, 1] = means[4, 0] = value
    finite = np.empty(4, np.bool_)
    find_finite(means, factors, np.array([0, 1, 2, 3]), finite)
    assert finite.tolist() == [True, False, True, False]


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


@pytest.mark.parametrize(
    ("length", "within"), [(1, True), (0.11, True), (0.09, False), (9.9, True), (10.1, False), (np.nan, False)]
)
def test_axes_are_within_a_tenth_and_ten_times_their_length(length: float, within: bool) -> None:
    lengths = np.array([[0.5, 0.5, 0.5], [1, 2, 3], [np.nan] * 3], np.float32)  # the last row does not move
    squares = np.square(lengths[:2])
    squares[1, 2] *= length**2
    assert axes_are_within(squares, np.arange(2), lengths, np.float32(0.1), np.float32(10)) == within


def test_gaussians_behind_or_beside_all_cameras_are_outside() -> None:
    pose = np.eye(4)[None, :3]  # looks along z from the origin
    lens = np.array([[100.0, 100, 50, 50, 100, 100]])
    means = np.array([[0, 0, 2], [0, 0, -2], [2, 0, 2], [1.02, 0, 2], [5, 0, 2]], np.float32)
    factors = np.tile(0.02 * np.eye(3, dtype=np.float32), (5, 1, 1))
    outside = np.zeros(5, np.bool_)
    find_outside(means, factors, np.arange(4), pose, lens, 3.0, outside)
    np.testing.assert_array_equal(outside, [False, True, True, False, False])  # the last row was not asked for
