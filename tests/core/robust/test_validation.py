"""States that may be committed: wrong rows are held alone, too many fail the attempt, axes stay in their bounds."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from frame_cases.scene import first_state, gone

from scas4d_core.gaussians import Gaussians
from scas4d_core.robust.checks import (
    BRIGHTEST,
    FARTHEST,
    FEW,
    LONGEST,
    SHRUNK,
    STRETCHED,
    axis_lengths,
    check_plausible,
)
from scas4d_core.update.result import UpdateResult, UpdateTrace

BEFORE = first_state(resting_may_move=True)
AFTER = gone(BEFORE, 0.05)
ROWS = np.flatnonzero(BEFORE.moving)
RADIUS = 1.5
ROW = 17


def checked(state: Gaussians, radius: float, first: np.ndarray | None = None) -> tuple[UpdateResult, str | None]:
    return check_plausible(BEFORE, UpdateResult(state, None, UpdateTrace()), ROWS, radius, first)


Spoil = Callable[[Gaussians], None]


def spoilt(*rows: int, by: Spoil) -> Gaussians:
    """The state after an update with some rows spoilt."""
    state = AFTER.replace(**{name: array.copy() for name, array in AFTER.arrays().items()})
    for row in rows:
        one = state.replace(**{name: array[row : row + 1] for name, array in state.arrays().items()})
        by(one)
    return state


def put(name: str, value: object) -> Spoil:
    def spoil(one: Gaussians) -> None:
        getattr(one, name)[:] = value

    return spoil


def inside_out(one: Gaussians) -> None:
    one.factors[0, :, 0] *= -1


SPOILS = {
    "position is NaN": put("means", np.nan),
    "position is infinite": put("means", np.inf),
    "position is gone far": put("means", FARTHEST * RADIUS * 2),
    "axes are NaN": put("factors", np.nan),
    "axes explode": put("factors", LONGEST * RADIUS * 2),
    "axes overflow": put("factors", 3e38),
    "rotation is NaN": put("rotations", np.nan),
    "rotation is no unit": put("rotations", 0.7),
    "colour is NaN": put("colours", np.nan),
    "colour explodes": put("colours", -BRIGHTEST * 2),
    "inside out": inside_out,
}


@pytest.mark.parametrize("kind", SPOILS)
def test_a_wrong_row_is_held_alone(kind: str) -> None:
    check, fault = checked(spoilt(ROW, by=SPOILS[kind]), RADIUS)
    assert (check.frozen, fault) == (1, None)
    for name, array in check.gaussians.arrays().items():
        np.testing.assert_array_equal(array[ROW], BEFORE.arrays()[name][ROW])
        np.testing.assert_array_equal(np.delete(array, ROW, 0), np.delete(AFTER.arrays()[name], ROW, 0))


@pytest.mark.parametrize("kind", SPOILS)
def test_too_many_wrong_rows_fail_the_attempt(kind: str) -> None:
    many = ROWS[: int(FEW * len(ROWS)) + 2]
    check, fault = checked(spoilt(*many, by=SPOILS[kind]), RADIUS)
    assert fault is not None
    assert f"{len(many)} of {len(ROWS)}" in fault
    assert check.gaussians is BEFORE


def test_a_wrong_colour_of_what_stands_is_held_too() -> None:
    row = int(np.flatnonzero(~BEFORE.moving)[0])
    check, fault = checked(spoilt(row, by=SPOILS["colour is NaN"]), RADIUS)
    assert (check.frozen, fault) == (1, None)
    np.testing.assert_array_equal(check.gaussians.colours[row], BEFORE.colours[row])


def test_what_is_plausible_is_passed_on_as_it_is() -> None:
    check, fault = checked(AFTER, RADIUS, axis_lengths(BEFORE))
    assert check.gaussians is AFTER
    assert (check.frozen, fault, check.bounded) == (0, None, 0)


@pytest.mark.parametrize(("factor", "bound"), [(SHRUNK / 5, SHRUNK), (STRETCHED * 2, STRETCHED)])
def test_an_axis_stays_in_its_bounds_and_keeps_its_direction(factor: float, bound: float) -> None:
    state = spoilt(by=inside_out)
    state.factors[ROW, :, 1] *= factor
    check, fault = checked(state, 100.0, axis_lengths(BEFORE))
    assert (check.frozen, fault, check.bounded) == (0, None, 1)
    expected = AFTER.factors.copy()
    expected[ROW, :, 1] *= bound
    np.testing.assert_allclose(check.gaussians.factors, expected, rtol=1e-5)


def test_an_axis_of_no_length_and_bounds_beside_a_held_row() -> None:
    state = spoilt(ROW, by=SPOILS["position is NaN"])
    state.factors[ROW + 1, :, 2] = 0
    state.factors[ROW + 2, :, 0] *= 1e-6
    check, fault = checked(state, RADIUS, axis_lengths(BEFORE))
    assert (check.frozen, fault) == (1, None)
    assert np.isfinite(check.gaussians.factors).all()
    assert axis_lengths(check.gaussians)[ROW + 2, 0] == pytest.approx(
        SHRUNK * axis_lengths(BEFORE)[ROW + 2, 0], rel=1e-4
    )
