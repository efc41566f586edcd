"""The first update of a scene in several orders of its views: which end is taken, and where there are several."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from box_scene import MOVING, make_box, make_rig, moved, take_frame
from scipy.spatial.transform import Rotation

from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.frame_outcome import OTHER_ORDERS, Candidate
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.robust import first_motion
from scas4d_core.robust.first_motion import ANOTHER_ORDER, FASTER, OrderResult, best_order
from scas4d_core.robust.outliers import Past
from scas4d_core.robust.solve_frame import FrameSolver
from scas4d_core.settings import Settings, UpdateSettings
from scas4d_core.update.result import UpdateResult, UpdateTrace

RIG, BOX = make_rig(), make_box()
FAR = moved(BOX, Rotation.from_rotvec([0.05, 0.25, 0.0]), np.array([0.08, 0.0, -0.05]))
FURTHER = moved(BOX, Rotation.from_rotvec([0.1, 0.5, 0.0]), np.array([0.16, 0.0, -0.1]))
NAMES = ("c0", "c1", "c2")


def end(error: float, *, fault: str | None = None, kept: Candidate = Candidate.END, fits: Any = NAMES) -> OrderResult:
    """An end whose cameras have this root mean square error."""
    trace = UpdateTrace([0.1], seconds={"start": 2.0, "end": 1.0}, kept=kept)
    return OrderResult(UpdateResult(BOX, None, trace), fault, dict.fromkeys(fits, -20 * math.log10(error)))


def ends(*given: OrderResult) -> Any:
    """Runs that end so, and the seeds and factors that they were given."""
    asked: list[tuple[int, float]] = []

    def run(seed: int, layer_rate_factor: float) -> OrderResult:
        asked.append((seed, layer_rate_factor))
        return given[len(asked) - 1]

    return run, asked


def best_of(*given: OrderResult) -> tuple[int, int]:
    """Which of some ends is taken, and how many ran."""
    best, orders = best_order(ends(*given)[0], 0)
    return next(k for k, one in enumerate(given) if one.fits is best.fits), orders


def test_two_orders_that_agree_are_enough_and_the_better_is_taken() -> None:
    assert best_of(end(0.0101), end(0.0100)) == (1, 2)
    run, asked = ends(end(0.0100), end(0.0101))
    assert best_order(run, 7)[1] == 2
    assert asked == [(7, FASTER[0]), (7 + ANOTHER_ORDER, FASTER[1])]


@pytest.mark.parametrize("errors", [(0.010, 0.013, 0.0102), (0.013, 0.010, 0.0102), (0.013, 0.0120, 0.010)])
def test_where_two_disagree_a_third_is_tried(errors: tuple[float, ...]) -> None:
    given = [end(error) for error in errors]
    assert best_of(*given) == (errors.index(min(errors)), 3)
    run, asked = ends(*given)
    best_order(run, 0)
    assert len({seed for seed, _ in asked}) == 3


@pytest.mark.parametrize("worse", [{"fault": "flew away"}, {"kept": Candidate.PREVIOUS}])
def test_a_state_that_cannot_be_or_did_not_move_is_the_last_choice(worse: dict[str, Any]) -> None:
    assert best_of(end(0.001, **worse), end(0.02), end(0.03)) == (1, 3)
    assert best_of(end(0.001, **worse), end(0.001, **worse), end(0.02)) == (2, 3)  # two of them do not agree
    assert best_of(*(end(0.001, **worse) for _ in range(3))) == (0, 3)


def test_what_is_not_finite_is_the_last_choice() -> None:
    assert best_of(end(math.nan), end(0.02), end(math.inf)) == (1, 3)


def test_a_camera_that_one_order_left_out_has_no_say() -> None:
    off = {"c0": 5.0, "c1": 40.0, "c2": 40.0}
    kept = end(0.01)._replace(fits=off)
    assert best_of(kept, end(0.0101, fits=("c1", "c2"))) == (0, 2)


def test_one_that_needed_no_iteration_is_not_tried_again() -> None:
    stood = OrderResult(UpdateResult(BOX, None, UpdateTrace()), None, {})
    assert best_of(stood) == (0, 1)


def test_seconds_of_the_other_orders_are_told() -> None:
    best, _ = best_order(ends(end(0.010), end(0.013), end(0.010))[0], 0)
    assert best.result.trace.seconds == {"start": 2.0, "end": 1.0, OTHER_ORDERS: 6.0}


def scene(**update: Any) -> Reconstruction:
    settings = Settings(update=UpdateSettings(iterations=15, clusters=(2, 12), **update))
    return Reconstruction.start(RIG, take_frame(0, 0.0, BOX, RIG), settings, static=StaticResult(BOX, {}, []))


def test_only_the_first_update_of_a_scene_is_tried_in_several_orders() -> None:
    one = scene()
    first = one.step(take_frame(1, 0.1, FAR, RIG))
    second = one.step(take_frame(2, 0.2, FURTHER, RIG))
    assert (OTHER_ORDERS in first.seconds, "orders" in first.attempts[0]) == (True, True)
    assert (OTHER_ORDERS in second.seconds, second.attempts) == (False, ["as set"])
    assert np.linalg.norm(one.history.newest.means - FURTHER.means, axis=1)[:MOVING].mean() < 0.02


@pytest.mark.parametrize("update", [{"cold_start_iterations": 1.0}, {"budget_ms": 200.0}])
def test_neither_where_it_may_take_no_longer_nor_by_the_clock(update: dict[str, float]) -> None:
    assert OTHER_ORDERS not in scene(**update).step(take_frame(1, 0.1, FAR, RIG)).seconds


def test_a_lost_order_is_not_what_a_scene_begins_with(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first order leaves all where it was: the state is that of another one, which shows where things are."""
    spoilt, ran = scene(), list[int]()
    run = FrameSolver._run

    def first(solver: FrameSolver, given: Any, start: Any, motion: Any, how: Any) -> UpdateResult:
        ran.append(given.seed)
        result = run(solver, given, start, motion, how)
        return result if len(ran) > 1 else replace(result, gaussians=start, motion=None)

    monkeypatch.setattr(first_motion, "FASTER", (1.0, 1.0, 1.0))
    monkeypatch.setattr(FrameSolver, "_run", first)
    spoilt.step(take_frame(1, 0.1, FAR, RIG))
    assert len(ran) == 3
    plain = scene()
    plain.step(take_frame(1, 0.1, FAR, RIG))
    missed = [np.linalg.norm(one.history.newest.means - FAR.means, axis=1)[:MOVING].mean() for one in (spoilt, plain)]
    assert missed[0] < 1.2 * missed[1] < 0.6 * np.linalg.norm(BOX.means - FAR.means, axis=1)[:MOVING].mean()


def test_a_scene_that_goes_on_without_its_carry_over_is_not_at_its_first_motion() -> None:
    one = scene()
    one.step(take_frame(1, 0.1, FAR, RIG))
    one._prepared = one._prepared.with_carry_over(motion=None, past=Past())
    assert OTHER_ORDERS not in one.step(take_frame(2, 0.2, FURTHER, RIG)).seconds
