"""The guards of the steps and of frame 0's parameters: what they make of what is not a number, and that they count."""

from __future__ import annotations

import numpy as np
import pytest

from scas4d_core.guards import GRADIENT_CEILING, MOMENT_FLOOR, GuardCounts, summed
from scas4d_core.kernels import activation
from scas4d_core.kernels.adam import COUNTED_GUARDS, EVERY_ROW, adam


@pytest.mark.parametrize(
    ("given", "taken", "guard_counts"),
    [
        (np.nan, 0.0, [1, 0]),
        (np.inf, GRADIENT_CEILING, [1, 0]),
        (-1e30, -GRADIENT_CEILING, [1, 0]),
        (1e-30, 0.0, [0, 1]),
        (MOMENT_FLOOR * 2, MOMENT_FLOOR * 2, [0, 0]),
        (0.0, 0.0, [0, 0]),
    ],
)
def test_a_number_that_a_guard_holds_is_counted_and_moves_no_other(
    given: float, taken: float, guard_counts: list[int]
) -> None:
    rng = np.random.default_rng(0)
    gradients = rng.normal(size=(1500, 3)).astype(np.float32)
    tables = [np.zeros((1500, 3), np.float32) for _ in range(6)]
    rates = np.full(3, 0.1, np.float32)
    clean = gradients.copy()
    clean[1100, 1] = taken
    gradients[1100, 1] = given
    for step in (1, 2):
        given_now, clean_now = gradients.copy(), clean.copy()
        counted = adam(tables[0], given_now, *tables[1:3], rates, EVERY_ROW, np.float32(0.9), np.float32(0.999), step)
        assert counted.tolist() == guard_counts
        assert adam(
            tables[3], clean_now, *tables[4:], rates, EVERY_ROW, np.float32(0.9), np.float32(0.999), step
        ).tolist() == [0, 0]
    for found, expected in zip(tables[:3], tables[3:], strict=True):
        np.testing.assert_array_equal(found, expected)
    assert np.isfinite(tables[0]).all()


def test_a_quaternion_without_direction_is_no_rotation_and_has_no_gradient() -> None:
    table = np.zeros((300, activation.COLUMNS), np.float32)
    table[:, 3] = 2
    table[7, 3:7] = 0
    table[8, 3:7] = 1e-20
    table[299, 7] = 200
    means, factors = np.empty((300, 3), np.float32), np.empty((300, 3, 3), np.float32)
    opacities, features = np.empty(300, np.float32), np.empty((300, 4), np.float32)
    assert activation.activate(table, means, factors, opacities, features).tolist() == [2, 1]
    np.testing.assert_array_equal(factors[[7, 8]], factors[[0, 0]])
    assert np.isfinite(factors).all()
    pulls = [np.ones_like(array) for array in (means, factors, opacities, features)]
    gradients = np.full_like(table, np.nan)
    activation.activate_backward(table, factors, opacities, features, *pulls, gradients)
    assert np.isfinite(gradients).all()
    assert (gradients[[7, 8], 3:7] == 0).all()


def test_counts_are_told_by_name_and_begin_again() -> None:
    counts = GuardCounts(*COUNTED_GUARDS)
    counts.add(COUNTED_GUARDS, np.array([[1, 2], [3, 4]]))
    counts.add(COUNTED_GUARDS[1:], np.array([5]))
    assert dict(counts) == {"gradient_ceiling": 4, "moment_floor": 11}
    assert summed([counts, {"folded": 1, "moment_floor": 1}]) == {
        "gradient_ceiling": 4,
        "moment_floor": 12,
        "folded": 1,
    }
    counts.reset()
    assert dict(counts) == {"gradient_ceiling": 0, "moment_floor": 0}
    with pytest.raises(ValueError, match="no_such"):
        GuardCounts("no_such")
